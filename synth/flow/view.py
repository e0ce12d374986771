"""One camera that looks at the states of one surface: what does not change between them, and what a state has shown.

Cached are the last few states' first hits: a trajectory's pairs share their states, and each state of a pair is needed
in both directions.

Pixels may meet a surface more than once: only there one part of it can hide another. The rays of a view cross the body
without meeting each other, so seeing is a continuous map F from the surface to the image plane. Where no boundary of
the surface is seen, the number of preimages of a pixel y, each counted +1 where the surface faces the camera and -1
where it turns its back, is the winding number of F(boundary) about y (the degree of the map; Milnor, Topology from the
Differentiable Viewpoint, § 5). If it is one, and y lies on the image of no triangle that turns its back, then exactly
one point of the surface is seen in y: nothing hides it, and it hides nothing.

Both conditions are tested with margins. A triangle faces the camera if its normal makes a positive angle's sine with
the rays at all three corners, larger than twice the difference between these rays; images of the other triangles and of
boundary edges lie in boxes around those of their corners, widened by a quarter and one pixel, far more than lenses and
refraction bend the image of one triangle. Views that the argument does not cover (mirrors; an edge of the gel in the
picture) get all their pixels.
"""

from collections import deque
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels, Points, Triangles
from synth.flow.field import FlowArray
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
_SLOPE = 1e-3
"""Least sine of the angle between a triangle and the rays that meet it."""
_WIDER = 0.25
"""Share of its size by which a box around an image of a triangle is widened, beside one pixel."""


def boundary_edges(triangles: Triangles) -> Triangles:
    """(e, 2) edges, in their triangle's direction, that no other triangle has in the opposite one."""
    edges = np.concatenate([triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))]).astype(np.int64)
    vertices = int(triangles.max()) + 1
    there, back = edges[:, 0] * vertices + edges[:, 1], edges[:, 1] * vertices + edges[:, 0]
    return np.asarray(edges[~np.isin(there, back)])


def may_overlap(positions: Points, triangles: Triangles, boundary: Triangles, optics: Optics) -> BoolArray:
    """The pixels (height, width) in which a point of the surface may be hidden from a camera; False is certain.

    Positions are (v, 3) float64 mm; the normals of the triangles (f, 3) point away from the camera (as `ContactFaces`
    says); the boundary is from `boundary_edges`.
    """
    width, height = size = optics.size
    everywhere: BoolArray = np.ones((height, width), dtype=bool)
    if optics.mirrors:
        return everywhere
    pixels = optics.project(positions)
    rays = optics.look(pixels).directions
    low, high = _boxes(pixels[boundary])
    with np.errstate(invalid="ignore"):
        is_outside = np.any(high < 0, axis=1) | np.any(low > size, axis=1)
    if not is_outside.all() or _windings(pixels[boundary], np.array(size) / 2) != 1:
        return everywhere
    low, high = _boxes(pixels[triangles[~_faces(positions[triangles], rays[triangles])]])
    if np.isnan(low).any():
        return everywhere
    first = np.clip(np.floor(low), 0, size).astype(np.intp)
    last = np.clip(np.ceil(high), 0, size).astype(np.intp)
    # Boxes as differences along both axes, then summed.
    steps = np.zeros((height + 1, width + 1), dtype=np.int32)
    for row, column, sign in ((first, first, 1), (first, last, -1), (last, first, -1), (last, last, 1)):
        np.add.at(steps, (row[:, 1], column[:, 0]), sign)
    return np.asarray(steps.cumsum(axis=0).cumsum(axis=1)[:height, :width] > 0)


def _faces(corners: FloatArray, rays: FloatArray) -> BoolArray:
    """(f,) whether triangles, (f, 3, 3) corners and rays there, face the camera; False for NaN."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        spread = np.linalg.norm(rays - np.roll(rays, 1, axis=1), axis=2).max(axis=1)
        sine = np.einsum("fk,fik->fi", normal, rays).min(axis=1)
        return np.asarray(sine > _SLOPE + 2 * spread)


def _boxes(corners: Pixels) -> tuple[Pixels, Pixels]:
    """Lower and upper corners (n, 2) of boxes in which the images of edges or triangles (n, k, 2) lie."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    margin = 1 + _WIDER * (high - low).max(axis=1, keepdims=True)
    return low - margin, high + margin


def _windings(edges: Pixels, centre: FloatArray) -> int:
    """How often closed chains of edges (e, 2, 2) run around a point, either way."""
    (ax, ay), (bx, by) = np.moveaxis(edges - centre, 0, -1)
    return abs(round(float(np.arctan2(ax * by - ay * bx, ax * bx + ay * by).sum() / (2 * np.pi))))


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
        if not overlap.any():
            return at[:0]
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
