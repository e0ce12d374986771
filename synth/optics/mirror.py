r"""Flat mirrors: which one a ray from the camera meets, and the virtual camera that sees by it.

A ray from the eye e that is reflected at the plane through p with the unit normal n goes on as if it came straight from
the virtual eye

.. math::  e' = e - 2 ((e - p) \cdot n) n

so a view through a mirror is a plain view of a camera with mirrored place and axes. What the virtual camera cannot know
is where the mirror ends and what stands in the way: `first_met` finds that from the ray itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Points
from synth.optics.pose import Pose
from synth.scene import Mirror

DIRECT, NOTHING = 0, -1
"""Path numbers: straight to the window; to nothing. Path k > 0 goes by mirror k - 1."""


@dataclass(frozen=True, eq=False)
class FlatMirror:
    """A rectangular mirror: centre (3,) mm, unit vectors (2, 3) along its sides, whose halves are (2,) mm.

    The unit normal (3,) points away from the reflecting side.
    """

    centre: FloatArray
    axes: FloatArray
    normal: FloatArray
    half: FloatArray

    @staticmethod
    def of(mirror: Mirror) -> "FlatMirror":
        *axes, normal = mirror.axes
        return FlatMirror(np.array(mirror.position_mm), np.array(axes), normal, np.array(mirror.size_mm) / 2)

    def turned(self, vectors: FloatArray) -> FloatArray:
        """Directions (..., 3) after reflection."""
        return np.asarray(vectors - 2 * (vectors @ self.normal)[..., None] * self.normal)

    def virtual(self, pose: Pose) -> Pose:
        position = pose.position - 2 * ((pose.position - self.centre) @ self.normal) * self.normal
        return Pose(position, *(self.turned(axis) for axis in (pose.right, pose.down, pose.forward)))

    def met(self, origins: Points, directions: Points) -> tuple[FloatArray, BoolArray]:
        """How far (n,) rays (n, 3) go to the mirror, infinite where they miss it, and whether they meet its front."""
        slope = directions @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((self.centre - origins) @ self.normal) / slope
            place = (origins + distance[:, None] * directions - self.centre) @ self.axes.T
            hit = (distance > 0) & (np.abs(place) <= self.half).all(1)
        return np.where(hit, distance, np.inf), slope < 0


def first_met(mirrors: Sequence[FlatMirror], eye: FloatArray, air: Points) -> NDArray[np.intp]:
    """Path numbers (n,) of rays in air that leave the eye (3,) in directions (n, 3).

    A ray that meets a mirror's back, or after its reflection another mirror, gets `NOTHING`: one reflection is all that
    is followed. All mirrors stand beyond the window, so that a ray meets them before it.
    """
    path = np.full(len(air), DIRECT)
    nearest = np.full(len(air), np.inf)
    front = np.ones(len(air), dtype=np.bool_)
    eyes = np.broadcast_to(eye, air.shape)
    for k, mirror in enumerate(mirrors):
        distance, facing = mirror.met(eyes, air)
        closer = distance < nearest
        path[closer], front[closer], nearest[closer] = k + 1, facing[closer], distance[closer]
    path[~front] = NOTHING
    for k, mirror in enumerate(mirrors):
        at = np.flatnonzero(path == k + 1)
        places, onward = eye + nearest[at, None] * air[at], mirror.turned(air[at])
        for other in mirrors:
            if other is not mirror:
                path[at[np.isfinite(other.met(places, onward)[0])]] = NOTHING
    return path
