"""Finite-element fields at given points of the undeformed contact face, for comparing meshes with one another."""

from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.simulate.space import Space
from synth.surface import quadratic_face

CHUNK = 500
"""Points that are looked up at once, each in every face."""
OUTSIDE = 1e-6
"""Barycentric coordinate by which a point may lie outside its face (rounding of coordinates of some mm)."""


def probe(space: Space, points: FloatArray) -> Any:
    """The sparse (k, n) matrix from nodal values of a space to values at points (k, 2) mm of the contact face.

    Raises:
        InputError: a point beside the pad.
    """
    import scipy.sparse as sp

    faces = space.faces[space.coated]
    a, b, c = np.moveaxis(space.points[faces[:, :3], :2], 1, 0)
    face, best = np.zeros(len(points), dtype=np.int64), np.zeros((len(points), 3))
    for first in range(0, len(points), CHUNK):
        weights = _barycentric(points[first : first + CHUNK, None, :], a, b, c)
        chosen = weights.min(axis=2).argmax(axis=1)
        face[first : first + CHUNK] = chosen
        best[first : first + CHUNK] = weights[np.arange(len(chosen)), chosen]
    if best.min() < -OUTSIDE:
        raise InputError(f"{points[int(best.min(axis=1).argmin())]} mm is no point of the contact face")
    shape = best if space.element.order == 1 else quadratic_face(best)
    rows = np.repeat(np.arange(len(points)), shape.shape[1])
    size = (len(points), len(space.points))
    return sp.csr_matrix((shape.ravel(), (rows, faces[face].ravel())), shape=size)


def _barycentric(p: FloatArray, a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """(k, f, 3) coordinates of points (k, 1, 2) in triangles with corners (f, 2)."""
    u, v, w = b - a, c - a, p - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    second = (w[..., 0] * v[:, 1] - w[..., 1] * v[:, 0]) / area
    third = (u[:, 0] * w[..., 1] - u[:, 1] * w[..., 0]) / area
    return np.stack([1 - second - third, second, third], axis=-1)
