r"""The flat outer face of the window, at which light bends once; gel and window have one refractive index n.

A point at depth h_p below that face and at lateral distance R from an eye at height h_c above it is seen at the slope t
(lateral run per unit of height, in air) that solves

.. math::  R = h_c t + \frac{h_p t}{\sqrt{n^2 + (n^2 - 1) t^2}}

which is Snell's law written for t. The right side is increasing and concave in t, so Newton's method started at
t = R / (h_c + h_p / n), which lies left of the root, climbs to it monotonically: no safeguard ever has to act.
The code solves for m = t / R, which stays finite on the axis (R = 0).
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points

_RELATIVE_STEP = 1e-9
"""Newton's error after a relative step s is of order s²; below 1e-9 the next iterate is exact to rounding."""
_MAX_ITERATIONS = 40


@dataclass(frozen=True)
class Window:
    """The face z = `face_z` mm between air above and a body of refractive index `index` below."""

    index: float
    face_z: float

    def aim(self, points: Points, eye: FloatArray) -> Points:
        """Directions (n, 3), of any length, in which an eye (3,) in air sees points (n, 3) below the face.

        NaN for points above the face and for an eye below it, where the face refracts.
        """
        arm = points - eye
        if self.index == 1:
            return arm
        if eye[2] <= self.face_z:
            return np.full_like(arm, np.nan)
        return np.column_stack([arm[:, :2] * self._slope_per_distance(points, eye)[:, None], np.full(len(arm), -1.0)])

    def enter(self, eye: FloatArray, air: Points) -> tuple[Points, Points]:
        """Rays in the body that continue rays in air from an eye (3,) mm in unit directions (n, 3).

        Origins (n, 3) mm on the face (at index 1: the eye) and unit directions (n, 3); NaN where a ray does not go
        down.
        """
        air = np.where(air[:, 2:] < 0, air, np.nan)
        if self.index == 1:
            return np.where(np.isnan(air), np.nan, eye), air
        origins = eye + air * ((self.face_z - eye[2]) / air[:, 2])[:, None]
        origins[:, 2] += self.face_z - origins[:, 2]  # exactly on the face; NaN stays NaN
        lateral = air[:, :2] / self.index
        return origins, np.column_stack([lateral, -np.sqrt(1 - (lateral**2).sum(1))])

    def shows(self, points: Points) -> BoolArray:
        """Which of the points (n, 3) a camera might see: those between the gel's face and this one."""
        return np.asarray((points[:, 2] > 0) & (points[:, 2] < self.face_z))

    def _slope_per_distance(self, points: Points, eye: FloatArray) -> FloatArray:
        """The root m = t / R (n,) 1/mm of the module's equation for points (n, 3)."""
        above, below = eye[2] - self.face_z, self.face_z - points[:, 2]
        below = np.where(below >= 0, below, np.nan)
        n2 = self.index**2
        x, y = points[:, 0] - eye[0], points[:, 1] - eye[1]
        bend = (n2 - 1) * (x * x + y * y)
        slope = 1 / (above + below / self.index)
        for _ in range(_MAX_ITERATIONS):
            square = n2 + bend * (slope * slope)
            root = np.sqrt(square)
            step = (1 - above * slope - below * slope / root) / (above + below * n2 / (root * square))
            slope = slope + step
            if not np.any(np.abs(step) > _RELATIVE_STEP * slope):
                break
        return slope
