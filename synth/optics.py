r"""The camera: rays from pixels and pixels from points, through the window and the lens.

Gel and window have one refractive index n, so light bends once, at the window's flat outer face z = z_w (gel thickness
plus window thickness); the camera stands in air above it. A point at depth h_p below that face and at lateral distance
R from a camera at height h_c above it is seen at the slope t (lateral run per unit of height, in air) that solves

.. math::  R = h_c t + \frac{h_p t}{\sqrt{n^2 + (n^2 - 1) t^2}}

which is Snell's law written for t. The right side is increasing and concave in t, so Newton's method started at
t = R / (h_c + h_p / n), which lies left of the root, climbs to it monotonically: no safeguard ever has to act.
The code solves for m = t / R, which stays finite on the axis (R = 0).

The lens is OpenCV's Brown-Conrady model (k1, k2, p1, p2, k3); its inverse is Newton's method with the analytic
Jacobian. The model is used only where it is one-to-one: up to the field radius at which the radial polynomial turns
back. Points beyond that and pixels that no ray reaches give NaN.

Frame (docs/decisions.md): forward f = look_at - position, normalised; right r is +x made orthogonal to f; down
d = r x f by components. The scene's axes are a left-handed triple, so everything here works by components.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import BoolArray, FloatArray, Pixels, Points
from synth.errors import InputError
from synth.scene import Sensor

_RELATIVE_STEP = 1e-9
"""Newton's error after a relative step s is of order s²; below 1e-9 the next iterate is exact to rounding."""
_MAX_ITERATIONS = 40


@dataclass(frozen=True, eq=False)
class Optics:
    """A camera behind a flat window.

    Attributes:
        position: (3,) mm, the pinhole.
        right, down, forward: (3,) unit vectors of the image's axes and of the viewing axis.
        focal: (fx, fy) px.
        centre: (cx, cy) px; the centre of pixel (row r, column c) is (c + 0.5, r + 0.5).
        distortion: k1, k2, p1, p2, k3.
        index: refractive index of gel and window.
        face_z: z of the window's outer face, mm.
    """

    position: FloatArray
    right: FloatArray
    down: FloatArray
    forward: FloatArray
    focal: FloatArray
    centre: FloatArray
    distortion: tuple[float, float, float, float, float]
    index: float
    face_z: float

    @staticmethod
    def of(sensor: Sensor) -> "Optics":
        """The optics of a sensor.

        Raises:
            InputError: the lens cannot image the principal point's surroundings, or the view is along x.
        """
        camera = sensor.camera
        position = np.array(camera.position_mm, dtype=np.float64)
        forward = np.array(camera.look_at_mm, dtype=np.float64) - position
        forward /= np.linalg.norm(forward)
        right = np.array([1.0, 0.0, 0.0]) - forward[0] * forward
        length = float(np.linalg.norm(right))
        if length < 1e-6:
            raise InputError(
                f"sensor.camera looks along x (from {camera.position_mm} to {camera.look_at_mm}), so its image has no "
                "right: move look_at_mm or position_mm so that the camera looks down at the gel"
            )
        right /= length
        return Optics(
            position=position,
            right=right,
            down=np.cross(right, forward),
            forward=forward,
            focal=np.array([camera.fx, camera.fy]),
            centre=np.array([camera.cx, camera.cy]),
            distortion=camera.distortion,
            index=sensor.window.refractive_index,
            face_z=sensor.gel.size_mm[2] + sensor.window.thickness_mm,
        )

    def project(self, points: Points) -> Pixels:
        """Pixels at which points inside the gel or window are seen.

        Args:
            points: (n, 3) float64 mm.

        Returns:
            (n, 2) float64 px, also outside the image; NaN for points that have no image: behind the camera, above the
            window's outer face (where there is one), or beyond the field of the lens model.
        """
        points = np.asarray(points, dtype=np.float64)
        arm = points - self.position
        if self.index != 1:
            arm = np.column_stack([arm[:, :2] * self._slope_per_distance(points)[:, None], np.full(len(arm), -1.0)])
        depth = arm @ self.forward
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (arm @ self.right) / depth, (arm @ self.down) / depth
            seen = (depth > 0) & (x * x + y * y < self.field_limit)
        distorted = self._distort(np.where(seen, x, np.nan), np.where(seen, y, np.nan))
        return np.column_stack(distorted) * self.focal + self.centre

    def rays(self, pixels: Pixels) -> tuple[Points, Points]:
        """Rays along which pixels look, inside the gel.

        Args:
            pixels: (n, 2) float64 px, anywhere, also between pixel centres.

        Returns:
            Origins (n, 3) mm on the window's outer face (at index 1: the camera's position) and unit directions (n, 3);
            NaN for pixels that no ray reaches: outside the range of the lens model or looking away from the window.
        """
        undistorted = self._undistort((np.asarray(pixels, dtype=np.float64) - self.centre) / self.focal)
        air = self.forward + undistorted[:, :1] * self.right + undistorted[:, 1:] * self.down
        air /= np.linalg.norm(air, axis=1, keepdims=True)
        air[~(air[:, 2] < 0)] = np.nan
        if self.index == 1:
            return np.where(np.isnan(air), np.nan, self.position), air
        origins = self.position + air * ((self.face_z - self.position[2]) / air[:, 2])[:, None]
        origins[:, 2] += self.face_z - origins[:, 2]  # exactly on the face; NaN stays NaN
        lateral = air[:, :2] / self.index
        return origins, np.column_stack([lateral, -np.sqrt(1 - (lateral**2).sum(1))])

    def depth(self, points: Points) -> FloatArray:
        """Distance (n,) mm of points (n, 3) mm from the camera along its viewing axis, straight through the window."""
        return (points - self.position) @ self.forward

    @property
    def field_limit(self) -> float:
        """Square of the undistorted radius (dimensionless) up to which the lens model is one-to-one."""
        k1, k2, _, _, k3 = self.distortion
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])  # d/dr of r (1 + k1 r² + k2 r⁴ + k3 r⁶), in r²
        real = roots[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].real
        positive = real[real > 0]
        return float(positive.min()) if len(positive) else np.inf

    def _slope_per_distance(self, points: Points) -> FloatArray:
        """The root m = t / R (n,) 1/mm of the module's equation for points (n, 3)."""
        above, below = self.position[2] - self.face_z, self.face_z - points[:, 2]
        below = np.where(below >= 0, below, np.nan)
        n2 = self.index**2
        square = ((points[:, :2] - self.position[:2]) ** 2).sum(1)
        slope = 1 / (above + below / self.index)
        for _ in range(_MAX_ITERATIONS):
            root = np.sqrt(n2 + (n2 - 1) * square * slope**2)
            step = (1 - above * slope - below * slope / root) / (above + below * n2 / root**3)
            slope = slope + step
            if not np.any(np.abs(step) > _RELATIVE_STEP * slope):
                break
        return slope

    def _distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
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
        tx, ty = target[:, 0], target[:, 1]
        limit = self.field_limit
        # Start inside the field: pixels far outside a barrel lens' image circle would start beyond it.
        shrink = np.minimum(1, 0.9 * np.sqrt(limit / np.maximum(tx * tx + ty * ty, 1e-300)))
        x, y = tx * shrink, ty * shrink
        error = self._error(x, y, target)
        for _ in range(_MAX_ITERATIONS):
            xx, xy, yy = self._distortion_jacobian(x, y)
            fx, fy = self._distort(x, y)
            determinant = xx * yy - xy * xy
            with np.errstate(divide="ignore", invalid="ignore"):
                dx = (yy * (tx - fx) - xy * (ty - fy)) / determinant
                dy = (xx * (ty - fy) - xy * (tx - fx)) / determinant
            dx, dy = np.nan_to_num(dx), np.nan_to_num(dy)
            scale = np.ones_like(dx)
            for _halving in range(8):  # only where the residual would grow
                worse = self._error(x + scale * dx, y + scale * dy, target) > error
                if not worse.any():
                    break
                scale[worse] /= 2
            x, y = x + scale * dx, y + scale * dy
            error = self._error(x, y, target)
            if not np.any(np.hypot(dx, dy) > _RELATIVE_STEP * (1 + np.hypot(x, y))):
                break
        return np.where(self._is_inside(x, y, error)[:, None], np.column_stack([x, y]), np.nan)

    def _error(self, x: FloatArray, y: FloatArray, target: FloatArray) -> FloatArray:
        fx, fy = self._distort(x, y)
        return np.hypot(fx - target[:, 0], fy - target[:, 1])

    def _is_inside(self, x: FloatArray, y: FloatArray, error: FloatArray) -> BoolArray:
        """Converged (to rounding of a coordinate of order 1) and on the branch of the lens model that is one-to-one."""
        xx, xy, yy = self._distortion_jacobian(x, y)
        inside = (x * x + y * y < self.field_limit) & (xx * yy - xy * xy > 0) & (xx + yy > 0)
        return inside & (error <= 1e-12 * (1 + np.hypot(x, y)))
