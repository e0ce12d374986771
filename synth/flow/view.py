"""One camera that looks at the states of one surface: what does not change between them, and what a state has shown.

Cached are the last few states' first hits: a trajectory's pairs share their states, and each state of a pair is needed
in both directions. Visibility is traced only where one part of the surface may hide another (`synth.flow.overlap`).
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels, Points, Triangles
from synth.flow.field import FlowArray
from synth.flow.overlap import boundary_edges, may_overlap
from synth.flow.trace import Hits, Tree
from synth.optics import Optics, Rays
from synth.surface import GelSurface

OCCLUSION_TOLERANCE_MM = 1e-6
"""A hit nearer than the point itself by more than this hides it.

Projection and its inverse agree to about 1e-12 px, so the ray of a point's own pixel passes it at less than 1e-12 mm
and meets its own surface within 1e-12 mm / sin(grazing angle): below the tolerance for every angle above 1e-6 rad.
Parts of the surface less than 1e-6 mm apart touch.
"""
_CACHED_STATES = 3
"""States of which the first hits are cached: those of a pair, and the undeformed one."""
_TILE = 1 << 14
"""Pixels worked on at a time: their float64 stays in a core's cache, and memory is that of the results."""


@dataclass(frozen=True, eq=False)
class View:
    """One camera looking at states of one surface, of which the triangles are used; rays are traced on the device."""

    surface: GelSurface
    optics: Optics
    device: str = "cpu"

    @cached_property
    def _is_whole(self) -> bool:
        """Whether every place in the image looks straight at the window."""
        width, height = self.optics.size
        corners = np.array([(x, y) for x in (0.0, width) for y in (0.0, height)])
        return bool((self.optics.own.path == 0).all() and (self.optics.look(corners).path == 0).all())

    @cached_property
    def _boundary(self) -> Triangles:
        return boundary_edges(self.surface.triangles)

    def overlap(self, positions: Points) -> BoolArray | None:
        """Pixels (H, W) in which one part of a state may hide another; None for any place of the image."""
        if not self._is_whole:
            return None
        return may_overlap(positions, self.surface.triangles, self._boundary, self.optics)

    @cached_property
    def _seen(self) -> "deque[SeenState]":
        return deque(maxlen=_CACHED_STATES)

    def state(self, positions: Points) -> "SeenState":
        """The surface in a state (v, 3) mm; the array must not be changed afterwards."""
        known = next((one for one in self._seen if one.positions is positions), None)
        if known is not None:
            self._seen.remove(known)  # the last that was asked for is kept longest
        self._seen.append(known or SeenState(self, positions))
        return self._seen[-1]

    def motion(self, hits: Hits, target: Points) -> tuple[FlowArray, FlowArray]:
        """Flow (H, W, 2) and visibility (H, W) of the hits' material points when the surface moves to `target`."""
        optics, state = self.optics, self.state(target)
        width, height = optics.size
        motion, visible = np.empty((width * height, 2), dtype=np.float32), np.empty(width * height, dtype=np.float32)
        for tile in self.tiles():
            points, path = hits[tile].interpolate(self.surface.triangles, target), optics.own.path[tile]
            pixels, visible[tile] = state.look_at(points, path)
            motion[tile] = pixels - optics.centres[tile]
        return motion.reshape(height, width, 2), visible.reshape(height, width)

    def tiles(self) -> Iterator[slice]:
        """Parts of the pixels, row by row."""
        pixels = self.optics.size[0] * self.optics.size[1]
        return (slice(start, min(start + _TILE, pixels)) for start in range(0, pixels, _TILE))

    def image(self, values: FloatArray | BoolArray) -> FlowArray:
        """Values (n,) of the pixels as an image (H, W)."""
        width, height = self.optics.size
        return values.astype(np.float32).reshape(height, width)

    def vector(self, name: str, values: FloatArray) -> dict[str, FlowArray]:
        """Vectors (n, 3) of the pixels as three channels."""
        return {f"{name}.{axis}": self.image(values[:, i]) for i, axis in enumerate("XYZ")}


@dataclass(frozen=True, eq=False)
class SeenState:
    """What a view has found out of one state of its surface, positions (v, 3) mm."""

    view: View
    positions: Points

    @cached_property
    def _tree(self) -> Tree:
        return Tree(self.positions, self.view.surface.triangles, self.view.device)

    @cached_property
    def hits(self) -> Hits:
        """What the pixel centres see."""
        own = self.view.optics.own
        return self._tree.first_hits(own.origins, own.directions)

    @cached_property
    def _overlap(self) -> BoolArray | None:
        return self.view.overlap(self.positions)

    def look_at(self, points: Points, path: NDArray[np.intp]) -> tuple[Pixels, BoolArray]:
        """Pixels (n, 2) of points (n, 3) mm of the state by paths (n,), and whether these show them."""
        optics = self.view.optics
        pixels = optics.project(points, path)
        seen = optics.is_inside(pixels)
        if (doubtful := self.doubtful(pixels, seen)).size:
            rays = optics.look(pixels[doubtful])
            seen[doubtful] = (rays.path == path[doubtful]) & self.is_unobstructed(points[doubtful], rays)
        return pixels, seen

    def doubtful(self, pixels: Pixels, inside: BoolArray) -> NDArray[np.intp]:
        """Numbers of the points, seen in pixels (n, 2) if `inside`, whose visibility must be traced."""
        at = np.flatnonzero(inside)
        if self._overlap is None:
            return at
        column, row = pixels[at].astype(np.intp).T
        return at[self._overlap[row, column]]

    def is_unobstructed(self, points: Points, rays: Rays) -> BoolArray:
        """Whether rays (n) reach these points (n, 3) mm of the state before anything else of it."""
        first = self._tree.first_hits(rays.origins, rays.directions).distance
        return first >= np.linalg.norm(points - rays.origins, axis=1) - OCCLUSION_TOLERANCE_MM
