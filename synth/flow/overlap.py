"""Where one part of a surface may hide another from a camera: only there visibility has to be traced.

A pixel may meet a surface more than once: only there one part of it can hide another. The rays of a view cross the body
without meeting each other, so seeing is a continuous map F from the surface to the image plane. Where no boundary of
the surface is seen, the number of preimages of a pixel y, each counted +1 where the surface faces the camera and -1
where it turns its back, is the winding number of F(boundary) about y (the degree of the map; Milnor, Topology from the
Differentiable Viewpoint, § 5). If it is one, and y lies on the image of no triangle that turns its back, then exactly
one point of the surface is seen in y: nothing hides it, and it hides nothing.

Both conditions are tested with margins. A triangle faces the camera if the sine of the angle between it and the rays is
positive at all three corners, and larger than twice the difference between these rays. Images of the other triangles
and of boundary edges lie in boxes around those of their corners, widened by a quarter and one pixel: far more than
lenses and refraction bend the image of one triangle. Views that the argument does not cover (mirrors; an edge of the
gel in the picture) get all their pixels.
"""

import numpy as np

from synth.arrays import BoolArray, FloatArray, Pixels, Points, Triangles
from synth.optics import Optics

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
