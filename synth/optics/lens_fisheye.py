r"""OpenCV's fisheye lens (module cv2.fisheye): equidistant projection with an odd polynomial.

.. math::  r_d = θ_d(θ) = θ (1 + k_1 θ^2 + k_2 θ^4 + k_3 θ^6 + k_4 θ^8)

for light at the angle θ to the axis, and the pixel at r_d times the focal length from the centre, in the light's own
direction. Used where it is one-to-one: up to where θ_d turns back, and below 110 degrees to the axis, 20 of them behind
the lens. The inverse is Newton's method kept inside a bracket that bisection shrinks.

Reference: Kannala and Brandt, "A generic camera model and calibration method for conventional, wide-angle, and
fish-eye lenses", IEEE TPAMI 28(8), 2006.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from synth.arrays import FloatArray, Pixels, Points
from synth.optics.lens_pinhole import smallest_positive_root

WIDEST = np.radians(110)
"""Largest angle to the axis: half of the field of the widest lenses that are made."""
_STEPS = 60
"""Bisection alone would reach float64's resolution of such an angle in 54."""


@dataclass(frozen=True, eq=False)
class FisheyeLens:
    """Equidistant projection and its polynomial.

    Attributes:
        focal: (fx, fy) px per radian.
        centre: (cx, cy) px.
        distortion: k1, k2, k3, k4.
    """

    focal: FloatArray
    centre: FloatArray
    distortion: tuple[float, ...]

    def project(self, local: Points) -> Pixels:
        """Pixels (n, 2) of directions (n, 3) in the camera's frame; NaN beyond the lens's field."""
        across = np.hypot(local[:, 0], local[:, 1])
        angle = np.arctan2(across, local[:, 2])
        angle = np.where(angle < self.field_limit, angle, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(across > 0, self._distorted(angle) / across, np.where(np.isnan(angle), np.nan, 0.0))
        return local[:, :2] * scale[:, None] * self.focal + self.centre

    def directions(self, pixels: Pixels) -> Points:
        """Unit directions (n, 3) of pixels (n, 2); NaN where the lens does not look."""
        place = (pixels - self.centre) / self.focal
        radius = np.hypot(place[:, 0], place[:, 1])
        angle = self._angle(radius)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(radius > 0, np.sin(angle) / radius, 1.0)
        return np.column_stack([place * scale[:, None], np.cos(angle)])

    @cached_property
    def field_limit(self) -> float:
        """Angle to the axis, radians, below which the lens model is one-to-one: at most `WIDEST`."""
        k1, k2, k3, k4 = self.distortion
        first = smallest_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])  # derivative of θ_d, in θ²
        return min(WIDEST, float(np.sqrt(first)))

    def _distorted(self, angle: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = self.distortion
        s = angle * angle
        return angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))

    def _slope(self, angle: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = self.distortion
        s = angle * angle
        return 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))

    def _angle(self, radius: FloatArray) -> FloatArray:
        """The angles (n,) whose distorted radii (n,) are given; NaN beyond the field."""
        limit = self.field_limit
        inside = radius < float(self._distorted(np.array(limit)))
        target = np.where(inside, radius, 0.0)
        low, high = np.zeros_like(target), np.full_like(target, limit)
        angle = np.minimum(target, limit)
        for _ in range(_STEPS):
            miss = self._distorted(angle) - target
            low, high = np.where(miss <= 0, angle, low), np.where(miss >= 0, angle, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                trial = angle - miss / self._slope(angle)
            after = np.where((trial >= low) & (trial <= high), trial, (low + high) / 2)
            moved = np.abs(after - angle)
            angle = after
            if np.all(moved <= 1e-15 * (1 + angle)):
                break
        return np.where(inside, angle, np.nan)
