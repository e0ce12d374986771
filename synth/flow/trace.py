"""Nearest hits of rays with a triangle surface, in float64 and deterministic, by Warp kernels.

Warp's tree of bounding boxes, which is in float32, proposes triangles: their boxes are widened by far more than float32
rounds. Each is then tested in float64 (Möller & Trumbore 1997). Rays may go in any direction.

Edges belong to both their triangles: barycentric coordinates down to -1e-9 count as inside, which is far above the
rounding of the test (about 1e-13) and far below anything visible, so no ray falls through between two triangles. Of
several hits the nearest counts, and of equally near ones the triangle of lowest index: an order that does not depend on
that in which triangles are met, so results are the same in every run. Edge-on triangles are never hit themselves; their
neighbours' edges are.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from synth.arrays import FloatArray, Points, Triangles
from synth.warp_start import start_warp

start_warp()

_MARGIN = 1e-5
"""Share of the largest coordinate by which boxes are widened: about a hundred times what float32 rounds there."""
_TRIANGLES_PER_LEAF = 4
"""A setting of the tree that changes the time and no bit of a result."""


@dataclass(frozen=True)
class Hits:
    """Nearest hits of n rays: triangles, barycentric weights (n, 3) of their vertices, mm along the unit directions.

    Where nothing is hit these are -1, NaN and infinite.
    """

    triangle: NDArray[np.int32]
    barycentric: FloatArray
    distance: FloatArray

    def __getitem__(self, part: slice) -> "Hits":
        return Hits(self.triangle[part], self.barycentric[part], self.distance[part])

    def interpolate(self, triangles: Triangles, values: FloatArray) -> FloatArray:
        """Values (n, c) at the hits from values (v, c) at the vertices; NaN where nothing is hit."""
        corners = (values[vertices] for vertices in triangles[self.triangle].T)  # where nothing is hit, of the last one
        return np.asarray(sum(weight[:, None] * of for weight, of in zip(self.barycentric.T, corners, strict=True)))


def trace(positions: Points, triangles: Triangles, origins: Points, directions: Points) -> Hits:
    """Find where n rays first meet a surface; what lies behind their origins is not hit.

    Positions are (v, 3) float64 mm, triangles (f, 3) int32; origins (n, 3) float64 mm and unit directions (n, 3) are
    NaN for rays that do not exist.
    """
    return Tree(positions, triangles).first_hits(origins, directions)


class Tree:
    """A surface that is ready to be hit by rays on "cpu" or "cuda": see `trace`. Its arrays must not be changed."""

    def __init__(self, positions: Points, triangles: Triangles, device: str = "cpu") -> None:
        self._device, self._largest = device, float(np.abs(positions).max())
        corners = positions[triangles]
        margin = _MARGIN * self._largest
        boxes = [
            self._given(box, np.float32, wp.vec3)
            for box in (corners.min(axis=1) - margin, corners.max(axis=1) + margin)
        ]
        self._tree = wp.Bvh(*boxes, leaf_size=_TRIANGLES_PER_LEAF)
        self._surface = [self._given(positions, np.float64, wp.vec3d), self._given(triangles, np.int32, wp.int32)]

    def first_hits(self, origins: Points, directions: Points) -> Hits:
        """Nearest hits of n rays."""
        margin = _MARGIN * max(self._largest, float(np.nanmax(np.abs(origins), initial=0.0)))
        rays = [self._given(array, np.float64, wp.vec3d) for array in (origins, directions)]
        kinds = (wp.int32, wp.vec3d, wp.float64)
        outputs = [wp.empty(len(origins), dtype=kind, device=self._device) for kind in kinds]
        inputs = [self._tree.id, margin, *self._surface, *rays]
        wp.launch(_nearest_hit, dim=len(origins), inputs=inputs, outputs=outputs, device=self._device)
        return Hits(*(array.numpy() for array in outputs))

    def _given(self, array: Any, kind: type, element: Any) -> Any:
        """A Warp array that kernels only read: on the CPU in the caller's own memory."""
        given = np.ascontiguousarray(array, dtype=kind)
        return wp.array(given, dtype=element, device=self._device, copy=self._device != "cpu")


@wp.func
def _single(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def _intersect(o: wp.vec3d, d: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec4d:
    """Distance and barycentric coordinates; the distance is negative where the triangle is not hit."""
    miss = wp.vec4d(wp.float64(-1.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    tolerance = wp.float64(-1e-9)
    ab, ac, ao = b - a, c - a, o - a
    normal = wp.cross(ab, ac)
    slant = -wp.dot(d, normal)
    moment = wp.cross(ao, d)
    v = wp.dot(ac, moment) / slant
    if v < tolerance:
        return miss
    w = -wp.dot(ab, moment) / slant
    u = wp.float64(1.0) - v - w
    if w < tolerance or u < tolerance or wp.abs(slant) <= wp.float64(1e-12) * wp.length(normal):
        return miss
    return wp.vec4d(wp.dot(ao, normal) / slant, u, v, w)


@wp.kernel
def _nearest_hit(
    tree: wp.uint64,
    margin: wp.float32,
    vertices: wp.array[wp.vec3d],
    corners: wp.array2d[wp.int32],
    origins: wp.array[wp.vec3d],
    directions: wp.array[wp.vec3d],
    triangle: wp.array[wp.int32],
    barycentric: wp.array[wp.vec3d],
    distance: wp.array[wp.float64],
) -> None:
    ray = wp.tid()
    o, d = origins[ray], directions[ray]
    nearest, weights, found = wp.float64(wp.inf), wp.vec3d(wp.float64(wp.nan)), wp.int32(-1)
    if wp.isfinite(d[0]):
        query = wp.bvh_query_ray(tree, _single(o), _single(d))
        t = wp.int32(0)
        while wp.bvh_query_next(query, t, wp.float32(nearest) + margin):
            hit = _intersect(o, d, vertices[corners[t, 0]], vertices[corners[t, 1]], vertices[corners[t, 2]])
            if hit[0] >= wp.float64(0.0) and (hit[0] < nearest or (hit[0] == nearest and t < found)):
                nearest, weights, found = hit[0], wp.vec3d(hit[1], hit[2], hit[3]), t
    triangle[ray] = found
    barycentric[ray] = weights
    distance[ray] = nearest
