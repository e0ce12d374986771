r"""OpenCV's lenses, used only where they are one-to-one. Points beyond and pixels that no ray reaches give NaN.

Pinhole with Brown-Conrady distortion (k1, k2, p1, p2, k3): up to the field radius at which the radial polynomial turns
back. The inverse is Newton's method with the analytic Jacobian.

Fisheye (module cv2.fisheye), equidistant projection with an odd polynomial:

.. math::  r_d = θ_d(θ) = θ (1 + k_1 θ^2 + k_2 θ^4 + k_3 θ^6 + k_4 θ^8)

for light at the angle θ to the axis, and the pixel at r_d times the focal length from the centre, in the light's own
direction; up to where θ_d turns back, and below 110 degrees to the axis, 20 of them behind the lens. The inverse is
Newton's method kept inside a bracket that bisection shrinks.

Reference: Kannala and Brandt, "A generic camera model and calibration method for conventional, wide-angle, and
fish-eye lenses", IEEE TPAMI 28(8), 2006.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from synth.arrays import BoolArray, FloatArray, Pixels, Points

_RELATIVE_STEP = 1e-9
"""Newton's error after a relative step s is of order s²; below 1e-9 the next iterate is exact to rounding."""
_MAX_ITERATIONS = 40
_MAX_HALVINGS = 8
"""Most halvings of a step that would make the residual grow."""
WIDEST = np.radians(110)
"""Largest angle to a fisheye lens's axis: half of the field of the widest lenses that are made."""
_STEPS = 60
"""Most steps to a fisheye lens's angle; bisection alone would reach float64's resolution of it in 54."""


@dataclass(frozen=True, eq=False)
class PinholeLens:
    """Pinhole and distortion: (fx, fy) px, (cx, cy) px, and k1, k2, p1, p2, k3."""

    focal: FloatArray
    centre: FloatArray
    distortion: tuple[float, ...]

    def project(self, local: Points) -> Pixels:
        """Pixels (n, 2) of directions (n, 3) in the camera's frame; NaN behind it or beyond the lens's field."""
        depth = local[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = local[:, 0] / depth, local[:, 1] / depth
            seen = (depth > 0) & (x * x + y * y < self.field_limit)
        distorted = self._distort(np.where(seen, x, np.nan), np.where(seen, y, np.nan))
        return np.column_stack(distorted) * self.focal + self.centre

    def directions(self, pixels: Pixels) -> Points:
        """Directions (n, 3) with z = 1 of pixels (n, 2); x and y are NaN where the lens does not look."""
        undistorted = self._undistort((pixels - self.centre) / self.focal)
        return np.column_stack([undistorted, np.ones(len(undistorted))])

    @cached_property
    def field_limit(self) -> float:
        """Square of the undistorted radius (dimensionless) up to which the lens model is one-to-one."""
        k1, k2, _, _, k3 = self.distortion
        return smallest_positive_root([7 * k3, 5 * k2, 3 * k1, 1.0])  # d/dr of r (1 + k1 r² + k2 r⁴ + k3 r⁶), in r²

    def _distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        if not any(self.distortion):
            return x, y
        k1, k2, p1, p2, k3 = self.distortion
        s = x * x + y * y
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        return x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y

    def _distortion_jacobian(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The symmetric Jacobian of `_distort`: its xx, xy and yy components."""
        k1, k2, p1, p2, k3 = self.distortion
        s = x * x + y * y
        radial = 1 + s * (k1 + s * (k2 + s * k3))
        slope = k1 + s * (2 * k2 + s * 3 * k3)
        xy = 2 * (x * y * slope + p1 * x + p2 * y)
        return (
            radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
            xy,
            radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
        )

    def _undistort(self, target: FloatArray) -> FloatArray:
        """Newton with step halving; (n, 2) -> (n, 2), NaN where the target has no preimage inside the field."""
        if not any(self.distortion):
            return target
        tx, ty = np.ascontiguousarray(target.T)
        limit = self.field_limit
        # Start inside the field: pixels far outside a barrel lens' image circle would start beyond it.
        shrink = np.minimum(1, 0.9 * np.sqrt(limit / np.maximum(tx * tx + ty * ty, 1e-300)))
        x, y = tx * shrink, ty * shrink
        left_x, left_y = self._residual(x, y, tx, ty)
        error = np.hypot(left_x, left_y)
        for _ in range(_MAX_ITERATIONS):
            xx, xy, yy = self._distortion_jacobian(x, y)
            determinant = xx * yy - xy * xy
            with np.errstate(divide="ignore", invalid="ignore"):
                dx = (yy * left_x - xy * left_y) / determinant
                dy = (xx * left_y - xy * left_x) / determinant
            dx, dy = np.nan_to_num(dx), np.nan_to_num(dy)
            scale: FloatArray | float = 1.0
            for halvings in range(_MAX_HALVINGS + 1):
                new_x, new_y = x + scale * dx, y + scale * dy
                left_x, left_y = self._residual(new_x, new_y, tx, ty)
                new_error = np.hypot(left_x, left_y)
                worse = new_error > error
                if halvings == _MAX_HALVINGS or not worse.any():
                    break
                scale = np.where(worse, scale / 2, scale)
            x, y, error = new_x, new_y, new_error
            if not np.any(np.hypot(dx, dy) > _RELATIVE_STEP * (1 + np.hypot(x, y))):
                break
        return np.where(self._is_inside(x, y, error)[:, None], np.column_stack([x, y]), np.nan)

    def _residual(
        self, x: FloatArray, y: FloatArray, target_x: FloatArray, target_y: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        distorted_x, distorted_y = self._distort(x, y)
        return target_x - distorted_x, target_y - distorted_y

    def _is_inside(self, x: FloatArray, y: FloatArray, error: FloatArray) -> BoolArray:
        """Converged (to rounding of a coordinate of order 1) and on the branch of the lens model that is one-to-one."""
        xx, xy, yy = self._distortion_jacobian(x, y)
        inside = (x * x + y * y < self.field_limit) & (xx * yy - xy * xy > 0) & (xx + yy > 0)
        return inside & (error <= 1e-12 * (1 + np.hypot(x, y)))


@dataclass(frozen=True, eq=False)
class FisheyeLens:
    """Equidistant projection and its polynomial: (fx, fy) px per radian, (cx, cy) px, and k1, k2, k3, k4."""

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
        return min(WIDEST, float(np.sqrt(smallest_positive_root(self._slope))))

    @property
    def _slope(self) -> list[float]:
        """Coefficients of the derivative of θ_d in θ², the highest power first."""
        k1, k2, k3, k4 = self.distortion
        return [9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]

    def _distorted(self, angle: FloatArray) -> FloatArray:
        return np.asarray(angle * np.polyval([*reversed(self.distortion), 1.0], angle * angle))

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
                trial = angle - miss / np.polyval(self._slope, angle * angle)
            after = np.where((trial >= low) & (trial <= high), trial, (low + high) / 2)
            moved = np.abs(after - angle)
            angle = after
            if np.all(moved <= 1e-15 * (1 + angle)):
                break
        return np.where(inside, angle, np.nan)


def smallest_positive_root(coefficients: list[float]) -> float:
    """The smallest positive root of a polynomial, its highest power first; infinite where it has none."""
    roots = np.roots(coefficients)
    real = roots[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].real
    return float(real[real > 0].min(initial=np.inf))
