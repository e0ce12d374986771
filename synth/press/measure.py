"""Signed distances of points from a rigid body at given places, as a Warp kernel on the CPU."""

import numpy as np
import warp as wp

from synth.arrays import FloatArray, Points
from synth.press.distance import shape_vector, signed_distance
from synth.press.indenter import RigidBody


class Distance:
    """Signed distance of points of the gel from one body at one of several places.

    A place is where the body's origin is, `centres` (k, 3) mm, and its axes as columns, `rotations` (k, 3, 3).
    """

    def __init__(self, body: RigidBody, centres: FloatArray, rotations: FloatArray) -> None:
        self._kind = body.kind
        self._constant = [
            wp.array(body.shape[None], dtype=shape_vector, device="cpu"),
            wp.array(body.coefficients[None], dtype=wp.float64, device="cpu"),
            wp.array(np.ascontiguousarray(centres), dtype=wp.vec3d, device="cpu"),
            wp.array(np.ascontiguousarray(rotations), dtype=wp.mat33d, device="cpu"),
        ]

    def __call__(self, points: Points, place: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """Outward normals (n, 3), pad's frame, and distances (n,) mm of points (n, 3) from the body at places (n,)."""
        found = wp.empty(len(points), dtype=wp.vec4d, device="cpu")
        posed = [wp.array(points, dtype=wp.vec3d, device="cpu"), wp.array(place, dtype=wp.int32, device="cpu")]
        wp.launch(_measure, len(points), inputs=[self._kind, *self._constant, *posed], outputs=[found], device="cpu")
        values = found.numpy()
        return values[:, :3], values[:, 3]


@wp.kernel
def _measure(
    kind: int,
    shape: wp.array(dtype=shape_vector),
    coefficients: wp.array4d(dtype=wp.float64),
    centres: wp.array(dtype=wp.vec3d),
    rotations: wp.array(dtype=wp.mat33d),
    points: wp.array(dtype=wp.vec3d),
    place: wp.array(dtype=int),
    found: wp.array(dtype=wp.vec4d),
):
    i = wp.tid()
    p = place[i]
    y = wp.transpose(rotations[p]) * (points[i] - centres[p])
    d = signed_distance(kind, shape[0], y, 0, coefficients)
    n = rotations[p] * wp.vec3d(d[0], d[1], d[2])
    found[i] = wp.vec4d(n[0], n[1], n[2], d[3])
