"""A mirror, described a second time: by its corners, not by axes and half lengths as in `synth.optics.mirror`."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from synth.arrays import BoolArray, FloatArray, Points
from synth.scene import Mirror


@dataclass(frozen=True, eq=False)
class Plate:
    """A rectangle that reflects on the side from which its corners run with the normal by the right-hand rule.

    Attributes:
        corners: (4, 3) mm, around the rectangle.
        normal: (3,) unit, away from the reflecting side.
    """

    corners: FloatArray
    normal: FloatArray

    @staticmethod
    def of(mirror: Mirror) -> "Plate":
        """From the scene's description: the rectangle laid flat, spun, tilted up about its first side, and turned."""
        normal = np.array(mirror.normal) / math.hypot(*mirror.normal)
        width, height = mirror.size_mm
        flat = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [width / 2, height / 2, 0]
        level = math.hypot(normal[0], normal[1])
        # The direction of the first side is a quarter turn from the normal's foot; a mirror that lies keeps x.
        heading = math.atan2(normal[0], -normal[1]) if level > 1e-9 else 0.0
        tilt = math.atan2(level, normal[2])
        turn = Rotation.from_euler("ZXZ", [heading, tilt, math.radians(mirror.rotation_deg)])
        return Plate(turn.apply(flat) + np.array(mirror.position_mm), normal)

    def reflected(self, points: FloatArray) -> FloatArray:
        """Points (..., 3) on the other side of the mirror's plane: Householder's matrix about its first corner."""
        matrix = np.eye(3) - 2 * np.outer(self.normal, self.normal)
        return (points - self.corners[0]) @ matrix + self.corners[0]

    def is_before(self, point: FloatArray) -> bool:
        """Whether a point (3,) is on the reflecting side."""
        return bool((point - self.corners[0]) @ self.normal > 0)

    def crossing(self, start: FloatArray, end: Points) -> Points:
        """Where the lines from start to end meet the plane: the place that divides them as their heights."""
        a, b = (start - self.corners[0]) @ self.normal, (end - self.corners[0]) @ self.normal
        with np.errstate(divide="ignore", invalid="ignore"):
            share = a / (a - b)
        return start + np.asarray(share)[:, None] * (end - start)

    def crossed(self, start: FloatArray, end: Points) -> BoolArray:
        """Whether the segments from start, (3,) or (n, 3), to end (n, 3) go through the rectangle."""
        a, b = (start - self.corners[0]) @ self.normal, (end - self.corners[0]) @ self.normal
        place = self.crossing(start, end)
        within = a * b < 0
        for corner, following in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            with np.errstate(invalid="ignore"):
                within &= np.cross(following - corner, place - corner) @ self.normal >= 0
        return np.asarray(within)
