r"""The camera, derived a second time: nothing here is shared with `synth.optics`.

Refraction is Fermat's principle: light from a point takes the path of least optical length through the window's face,

.. math::  L(s) = \sqrt{s^2 + h_c^2} + n \sqrt{(R - s)^2 + h_p^2}

whose stationary point s (lateral distance from the camera to the crossing) lies between that of the straight line and
R and is bracketed there by the Illinois variant of regula falsi. The lens and the pinhole are OpenCV's `projectPoints`,
in OpenCV's right-handed world: the scene's with z reversed. There is no map from pixels to rays: `synth.verify.sheet`
inverts this one by root search.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from synth.arrays import FloatArray, Pixels, Points
from synth.scene import Sensor

_MIRROR = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class ForwardCamera:
    """Pixels from points.

    Attributes:
        eye: (3,) mm, scene frame.
        rotation: (3, 3), mirrored world to camera, right-handed.
        matrix: (3, 3) px, pinhole.
        distortion: k1, k2, p1, p2, k3.
        index: refractive index of gel and window.
        face_z: mm, the window's outer face.
        field: undistorted radius at which the lens model turns back.
    """

    eye: FloatArray
    rotation: FloatArray
    matrix: FloatArray
    distortion: FloatArray
    index: float
    face_z: float
    field: float

    @staticmethod
    def of(sensor: Sensor) -> "ForwardCamera":
        camera = sensor.camera
        eye = np.array(camera.position_mm, dtype=np.float64)
        ahead = (np.array(camera.look_at_mm) - eye) * _MIRROR
        ahead /= np.sqrt(ahead @ ahead)
        below = np.cross(ahead, [1.0, 0.0, 0.0])
        below /= np.sqrt(below @ below)
        return ForwardCamera(
            eye=eye,
            rotation=np.array([np.cross(below, ahead), below, ahead]),
            matrix=np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]),
            distortion=np.array(camera.distortion),
            index=sensor.window.refractive_index,
            face_z=sensor.gel.size_mm[2] + sensor.window.thickness_mm,
            field=_turning_radius(*(camera.distortion[i] for i in (0, 1, 4))),
        )

    def see(self, points: Points) -> Pixels:
        """Pixels (n, 2) of points (n, 3) mm below the window's face; NaN beyond the lens model's field."""
        aim = self._crossing(points) if self.index > 1 else points
        local = (aim - self.eye) * _MIRROR @ self.rotation.T
        lost = ~(local[:, 2] > 0) | ~(np.hypot(local[:, 0], local[:, 1]) < self.field * local[:, 2])
        local[lost] = (0, 0, 1)
        zero = np.zeros(3)
        pixels = (
            cv2.projectPoints(local[:, None], zero, zero, self.matrix, self.distortion)[0][:, 0]
            if len(local)
            else local
        )
        return np.where(lost[:, None], np.nan, pixels[:, :2])

    def _crossing(self, points: Points) -> Points:
        """Where light from the points crosses the window's face on its way to the eye, (n, 3) mm."""
        arm = points[:, :2] - self.eye[:2]
        reach = np.hypot(arm[:, 0], arm[:, 1])
        above, below = self.eye[2] - self.face_z, self.face_z - points[:, 2]

        def slope(s: FloatArray) -> FloatArray:
            rest = reach - s
            return s / np.hypot(s, above) - self.index * rest / np.hypot(rest, below)

        low, high = reach * above / (above + below), reach.copy()
        at_low, at_high = slope(low), slope(high)
        s = low
        for _ in range(60):
            with np.errstate(invalid="ignore", divide="ignore"):
                step = np.where(at_high != at_low, at_high * (high - low) / (at_high - at_low), 0.0)
            previous, s = s, high - step
            value = slope(s)
            # The end kept is `low`; where the new value falls on the side of `high`, low's value is halved (Illinois).
            crossed = value * at_high < 0
            low, at_low = np.where(crossed, high, low), np.where(crossed, at_high, at_low / 2)
            high, at_high = s, value
            if np.all(np.abs(s - previous) <= 1e-13 * reach):
                break
        share = np.divide(s, reach, out=np.zeros_like(s), where=reach > 0)
        return np.column_stack([self.eye[:2] + arm * share[:, None], np.full(len(points), self.face_z)])


def _turning_radius(k1: float, k2: float, k3: float) -> float:
    """Undistorted radius at which the distorted one first stops growing, from a table; infinite where it never does."""
    radius = np.linspace(0, 20, 200_001)
    square = radius**2
    distorted = radius * (1 + k1 * square + k2 * square**2 + k3 * square**3)
    stops = np.flatnonzero(np.diff(distorted) <= 0)
    return float(radius[stops[0]]) if len(stops) else np.inf
