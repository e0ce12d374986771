"""Evenly distributed random points on the faces of a mesh, and the functions nearest (L²) to samples on them."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from synth.render.gel_hits import GelHits

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
    def on(gel: GelHits, count: int, draws: int, seed: Any, mi: Any, nodes: Any = None) -> "FacePoints":
        """`count` points, each with as many `draws` of numbers, on each of the gel's faces, or at each of the nodes.

        The seed is mi.UInt32; nodes are from `smooth_light.Nodes.numbers`.
        """
        import drjit as dr

        total = dr.width(gel.corners[0] if nodes is None else nodes[0]) * count
        sampler = mi.load_dict({"type": "multijitter", "sample_count": count})
        sampler.set_samples_per_wavefront(count)
        sampler.seed(seed, total)
        first, *numbers = (sampler.next_2d() for _ in range(1 + draws))
        dr.eval(first, numbers)  # by a kernel of their own: the sampler's size is compiled into it
        face = dr.arange(mi.UInt32, total) // dr.opaque(mi.UInt32, count)
        if nodes is None:
            place = mi.warp.square_to_uniform_triangle(first)
            weights = (1 - place.x - place.y, place.x, place.y)
        else:
            first, second, third = (dr.gather(mi.Float, weight, face) for weight in nodes[1])
            weights, face = (first, second, third), dr.gather(mi.UInt32, nodes[0], face)
        vertices = [dr.gather(mi.UInt32, column, face) for column in gel.corners]
        a, b, c = (dr.gather(mi.Point3f, gel.positions, vertex) for vertex in vertices)
        at = dr.zeros(mi.SurfaceInteraction3f, total)
        at.p = a * weights[0] + b * weights[1] + c * weights[2]
        at.n = mi.Normal3f(dr.normalize(dr.cross(b - a, c - a)))
        return FacePoints(at, -gel.normal(face, weights), weights, iter(numbers))


def count_per_face(total: int, faces: int) -> int:
    """Points of each face where there are about `total` in all."""
    return (_STEP * max(1, round(math.sqrt(total / faces) / _STEP))) ** 2


def projected(values: list[Any], weights: tuple[Any, Any, Any], count: int, is_linear: Any) -> list[list[Any]]:
    """Corner values (channels of 3 of mi.Float) of the functions nearest to samples of evenly distributed points.

    Constant on faces that are not `is_linear` (mi.Bool).

    The corners' functions φ have the mass matrix A/12 (1 + I), whose inverse makes of the means m_i of φ_i f the
    values 12 m_i - 3 Σ m. The nearest constant is Σ m, since Σ φ = 1.
    """
    import drjit as dr

    parts = [[value * weight for weight in weights] for value in values]
    dr.eval(parts)
    means = [[dr.block_sum(part, count) / count for part in channel] for channel in parts]
    wholes = [channel[0] + channel[1] + channel[2] for channel in means]
    return [
        [dr.select(is_linear, 12 * mean - 3 * whole, whole) for mean in channel]
        for channel, whole in zip(means, wholes, strict=True)
    ]
