"""One camera that looks at the states of one surface: what does not change between them, and what a state has shown.

Cached are the last few states' first hits: a trajectory's pairs share their states, and each state of a pair is needed
in both directions. Visibility is traced only where one part of the surface may hide another (`synth.flow.overlap`).
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels, Points, Triangles
from synth.flow.field import FlowArray
from synth.flow.overlap import boundary_edges, may_overlap
from synth.flow.trace import Hits, trace
from synth.optics import Optics, Rays
from synth.surface import GelSurface

OCCLUSION_TOLERANCE_MM = 1e-6
"""A hit nearer than the point itself by more than this hides it.

Projection and its inverse agree to about 1e-12 px, so the ray of a point's own pixel passes it at less than 1e-12 mm
and meets its own surface within 1e-12 mm / sin(grazing angle): below the tolerance for every angle above 1e-6 rad.
Parts of the surface less than 1e-6 mm apart touch.
"""
_CACHED_STATES = 3
"""States whose first hits are cached: those of a pair, and the undeformed one."""


@dataclass(frozen=True, eq=False)
class View:
    """One camera looking at states of one surface, of which the triangles are used."""

    surface: GelSurface
    optics: Optics

    @cached_property
    def _is_whole(self) -> bool:
        """Whether every place in the image looks straight at the window."""
        width, height = self.optics.size
        corners = np.array([(x, y) for x in (0.0, width) for y in (0.0, height)])
        return bool((self.optics.own.path == 0).all() and (self.optics.look(corners).path == 0).all())

    @cached_property
    def _boundary(self) -> Triangles:
        return boundary_edges(self.surface.triangles)

    @cached_property
    def _seen(self) -> "deque[tuple[Points, Hits]]":
        return deque(maxlen=_CACHED_STATES)

    def first_hits(self, positions: Points) -> Hits:
        """What the pixel centres see of a state (v, 3) mm; the array must not be changed afterwards."""
        for known, hits in self._seen:
            if known is positions:
                return hits
        hits = trace(positions, self.surface.triangles, self.optics.own.origins, self.optics.own.directions)
        self._seen.append((positions, hits))
        return hits

    def motion(self, hits: Hits, target: Points) -> tuple[FlowArray, FlowArray]:
        """Flow (H, W, 2) and visibility (H, W) of the hits' material points when the surface moves to `target`."""
        points = hits.interpolate(self.surface.triangles, target)
        pixels = self.optics.project(points, self.optics.own.path)
        visible = self.optics.is_inside(pixels)
        doubtful = self._may_be_hidden(pixels, visible, target)
        rays = self.optics.look(pixels[doubtful])
        same = rays.path == self.optics.own.path[doubtful]
        visible[doubtful] = same & self._is_unobstructed(points[doubtful], rays, target)
        width, height = self.optics.size
        return (pixels - self.optics.centres).astype(np.float32).reshape(height, width, 2), self.image(visible)

    def _may_be_hidden(self, pixels: Pixels, inside: BoolArray, target: Points) -> NDArray[np.intp]:
        """Numbers of the points, seen in pixels (n, 2) if in any, whose visibility must be traced."""
        at = np.flatnonzero(inside)
        if not self._is_whole:
            return at
        overlap = may_overlap(target, self.surface.triangles, self._boundary, self.optics)
        column, row = pixels[at].astype(np.intp).T
        return at[overlap[row, column]]

    def _is_unobstructed(self, points: Points, rays: Rays, positions: Points) -> BoolArray:
        if len(points) == 0:
            return np.ones(0, dtype=bool)
        distance = np.linalg.norm(points - rays.origins, axis=1)
        first = trace(positions, self.surface.triangles, rays.origins, rays.directions).distance
        return first >= distance - OCCLUSION_TOLERANCE_MM

    def image(self, values: FloatArray | BoolArray) -> FlowArray:
        """Values (n,) of the pixels as an image (H, W)."""
        width, height = self.optics.size
        return values.astype(np.float32).reshape(height, width)

    def vector(self, name: str, values: FloatArray) -> dict[str, FlowArray]:
        """Vectors (n, 3) of the pixels as three channels."""
        return {f"{name}.{axis}": self.image(values[:, i]) for i, axis in enumerate("XYZ")}
