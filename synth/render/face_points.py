"""Evenly distributed random points on the faces of a mesh, and the functions nearest (L²) to samples on them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.arrays import BoolArray, Image

_STEP = 4
"""Points of a face are squares of its multiples: a sampler's size is compiled into the kernel."""


@dataclass(frozen=True, eq=False)
class FacePoints:
    """Points on faces, each face's one after another.

    Attributes:
        at: their surface interactions.
        normal: mi.Vector3f, unit, into the gel.
        weights: barycentric coordinates.
        sampler: of further random numbers, stratified within each face.
    """

    at: Any
    normal: Any
    weights: tuple[Any, Any, Any]
    sampler: Any

    @staticmethod
    def on(corners: list[Any], parameters: Any, count: int, seed: int, mi: Any) -> "FacePoints":
        """`count` points on each of the gel's faces, whose corners (3 of mi.UInt32) are vertices in `parameters`."""
        import drjit as dr

        total = dr.width(corners[0]) * count
        sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed % 2**32, total)
        face = dr.arange(mi.UInt32, total) // dr.opaque(mi.UInt32, count)
        place = mi.warp.square_to_uniform_triangle(sampler.next_2d())
        weights = (1 - place.x - place.y, place.x, place.y)
        vertices = [dr.gather(mi.UInt32, column, face) for column in corners]
        positions = dr.unravel(mi.Point3f, parameters["gel.vertex_positions"])
        normals = dr.unravel(mi.Vector3f, parameters["gel.vertex_normals"])
        a, b, c = (dr.gather(mi.Point3f, positions, vertex) for vertex in vertices)
        at = dr.zeros(mi.SurfaceInteraction3f, total)
        at.p = a * weights[0] + b * weights[1] + c * weights[2]
        at.n = mi.Normal3f(dr.normalize(dr.cross(b - a, c - a)))
        normal = sum(dr.gather(mi.Vector3f, normals, i) * w for i, w in zip(vertices, weights, strict=True))
        return FacePoints(at, -dr.normalize(normal), weights, sampler)  # vertex normals point out of the gel


def count_per_face(total: int, faces: int) -> int:
    """Points of each face, of about so many in all."""
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
