r"""Evenly distributed random points on the faces of a mesh, and the functions nearest (L²) to samples on them.

Light that a round gel sends to itself across its cavity is smooth (`across_cavity`). A point x of the face with the
normal n gets, from directions ω in which it sees the radiance L,

.. math::  E = \int L(ω) \max(n · ω, 0) \, dω = n · V(x), \qquad V(x) = \int L(ω) \, ω \, dω ,

where all of the gel lies above the point's horizon: exactly so in a convex cavity, nearly so where a contact bulges
into it. V is fitted to the means of all faces as polynomials of the place.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from synth.arrays import BoolArray, FloatArray, Image, Points

_STEP = 4
"""Points of a face are squares of its multiples: a sampler's size is compiled into the kernel."""


@dataclass(frozen=True, eq=False)
class FacePoints:
    """Points on faces, each face's one after another: surface interactions, barycentric weights, and unit normals.

    These, mi.Vector3f, point into the gel; `numbers` are random (mi.Point2f), stratified within each face.
    """

    at: Any
    normal: Any
    weights: tuple[Any, Any, Any]
    numbers: Iterator[Any]

    @staticmethod
    def on(corners: list[Any], parameters: Any, count: int, draws: int, seed: int, mi: Any) -> "FacePoints":
        """`count` points, each with as many `draws` of numbers, on each of the gel's faces.

        The faces' corners (3 of mi.UInt32) are vertices in `parameters`.
        """
        import drjit as dr

        total = dr.width(corners[0]) * count
        sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed % 2**32, total)
        first, *numbers = (sampler.next_2d() for _ in range(1 + draws))
        dr.eval(first, numbers)  # by a kernel of their own: the sampler's size is compiled into it
        face = dr.arange(mi.UInt32, total) // dr.opaque(mi.UInt32, count)
        place = mi.warp.square_to_uniform_triangle(first)
        weights = (1 - place.x - place.y, place.x, place.y)
        vertices = [dr.gather(mi.UInt32, column, face) for column in corners]
        positions = dr.unravel(mi.Point3f, parameters["gel.vertex_positions"])
        normals = dr.unravel(mi.Vector3f, parameters["gel.vertex_normals"])
        a, b, c = (dr.gather(mi.Point3f, positions, vertex) for vertex in vertices)
        at = dr.zeros(mi.SurfaceInteraction3f, total)
        at.p = a * weights[0] + b * weights[1] + c * weights[2]
        at.n = mi.Normal3f(dr.normalize(dr.cross(b - a, c - a)))
        normal = sum(dr.gather(mi.Vector3f, normals, i) * w for i, w in zip(vertices, weights, strict=True))
        return FacePoints(at, -dr.normalize(normal), weights, iter(numbers))  # vertex normals point out of the gel


def count_per_face(total: int, faces: int) -> int:
    """Points of each face where there are about `total` in all."""
    return (_STEP * max(1, round(math.sqrt(total / faces) / _STEP))) ** 2


def projected(values: list[Any], weights: tuple[Any, Any, Any], count: int, is_linear: BoolArray) -> Image:
    """Corner values (faces, channels, 3) of the functions nearest to samples of evenly distributed points.

    The corners' functions φ have the mass matrix A/12 (1 + I), whose inverse makes of the means m_i of φ_i f the
    values 12 m_i - 3 Σ m. The nearest constant is Σ m, since Σ φ = 1.
    """
    import drjit as dr

    parts = [value * weight for value in values for weight in weights]
    dr.eval(parts)
    means = np.stack([np.array(dr.block_sum(part, count)) for part in parts], axis=-1) / count
    means = means.reshape(-1, len(values), 3)
    whole = means.sum(axis=2, keepdims=True)
    return np.where(is_linear[:, None, None], 12 * means - 3 * whole, whole).astype(np.float32)


_DEGREE = 4
"""Degree of V's polynomials."""


def across_cavity(means: FloatArray, positions: Points, normals: Points, faces: np.ndarray) -> Image:
    """Irradiance at the corners of faces, (f, channels, 3) float32, from means (f, channels) sampled on each face.

    Vertices have positions (v, 3) and unit normals (v, 3), all on the same side of the faces (f, 3).
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    places = 2 * (positions - low) / (high - low) - 1
    centre, upright = places[faces].mean(axis=1), normals[faces].mean(axis=1)
    design = _terms(centre, upright)
    found = np.linalg.lstsq(design.T @ design, design.T @ means, rcond=None)[0]
    at_vertices = np.maximum(_terms(places, normals) @ found, 0)
    return np.ascontiguousarray(at_vertices[faces].swapaxes(1, 2), dtype=np.float32)


def _terms(places: Points, normals: Points) -> FloatArray:
    """(n, t) monomials of places times each component of the normals."""
    powers = [power for power in product(range(_DEGREE + 1), repeat=3) if sum(power) <= _DEGREE]
    monomials = np.stack([np.prod(places**power, axis=1) for power in powers], axis=1)
    return np.asarray((monomials[:, :, None] * normals[:, None, :]).reshape(len(places), -1))
