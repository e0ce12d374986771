r"""The camera, derived a second time: nothing here is shared with `synth.optics`.

A mirror is dealt with by moving what is behind it: the point, and the window's face, are reflected at the mirror's
plane, and the camera looks at their images. Refraction is Fermat's principle: light from a point takes the path of
least optical length through that face,

.. math::  L(s) = \sqrt{s^2 + h_c^2} + n \sqrt{(R - s)^2 + h_p^2}

whose stationary point s (distance along the face from the camera's foot to the crossing) lies between that of the
straight line and R and is bracketed there by the Illinois variant of regula falsi. For a round face see
`synth.verify.shell`. Pinhole and lenses are OpenCV's `projectPoints` and, up to `_OPENCV_FIELD` from the axis,
`fisheye.projectPoints`, in OpenCV's right-handed world: the scene's with z reversed. There is no map from pixels to
rays: `synth.verify.sheet` inverts this one by root search. Whether light of a point really gets to the camera on a path
is decided from the points at which that path turns (`reaches`).
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from synth.arrays import BoolArray, FloatArray, Pixels, Points
from synth.scene import Camera, Mirror, Sensor
from synth.verify.shell import Shell

_MIRROR = np.array([1.0, 1.0, -1.0])
_UP = np.array([0.0, 0.0, 1.0])
_OPENCV_FIELD = 1.5
"""Radians; OpenCV's fisheye model divides by the cosine and knows nothing behind the lens."""
_WIDER = 0.2
"""Radians; wider than a triangle of a round gel is seen."""


@dataclass(frozen=True, eq=False)
class Plate:
    """A mirror by its corners (4, 3) mm, not by axes and half lengths as in `synth.optics.mirror`.

    Its unit normal (3,) points away from the reflecting side, about which the corners run by the right-hand rule.
    """

    corners: FloatArray
    normal: FloatArray

    @staticmethod
    def of(mirror: Mirror) -> "Plate":
        """The plate of a scene's mirror: its rectangle laid flat, spun, tilted up about its first side, and turned."""
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


@dataclass(frozen=True, eq=False)
class ForwardCamera:
    """Pixels from points.

    Attributes:
        eye: (3,) mm, scene frame.
        rotation: (3, 3), mirrored world to camera, right-handed.
        matrix: (3, 3) px, pinhole.
        distortion: k1, k2, p1, p2, k3, or k1, k2, k3, k4 of a fisheye lens.
        is_fisheye: which of the two.
        index: refractive index of gel and window.
        face_z: mm, the outer face of a flat window.
        shell: the face of a round window.
        field: angle to the axis, radians, at which the lens model turns back.
        plates: the mirrors; path k > 0 is by plates[k - 1], path 0 is straight.
    """

    eye: FloatArray
    rotation: FloatArray
    matrix: FloatArray
    distortion: FloatArray
    is_fisheye: bool
    index: float
    face_z: float
    shell: Shell | None
    field: float
    plates: tuple[Plate, ...]

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
            is_fisheye=camera.lens == "fisheye",
            index=sensor.window.refractive_index,
            face_z=sensor.gel.size_mm[2] + sensor.window.thickness_mm,
            shell=Shell.of(sensor.window),
            field=_turning_angle(camera),
            plates=tuple(Plate.of(mirror) for mirror in sensor.mirrors),
        )

    @property
    def paths(self) -> range:
        return range(len(self.plates) + 1)

    def see(self, points: Points, path: int = 0) -> Pixels:
        """Pixels (n, 2) of points (n, 3) mm below the window's face; NaN beyond the lens model's field.

        By a mirror also where the mirror has ended: see `reaches`.
        """
        local = self._local(points, path)
        across, angle = np.hypot(local[:, 0], local[:, 1]), _angle(local)
        lost = ~(angle < self.field)
        wide = np.flatnonzero(self.is_fisheye & ~lost & (angle > _OPENCV_FIELD))
        radius = _fisheye_radius(angle[wide], self.distortion)[:, None] if len(wide) else 0.0
        beyond = local[wide, :2] / across[wide, None] * radius * np.diag(self.matrix)[:2] + self.matrix[:2, 2]
        local[lost] = (0, 0, 1)
        local[wide] = (0, 0, 1)
        if not len(local):
            return local[:, :2]
        zero = np.zeros(3)
        project = cv2.fisheye.projectPoints if self.is_fisheye else cv2.projectPoints
        pixels = project(local[:, None], zero, zero, self.matrix, self.distortion)[0][:, 0]
        pixels[wide] = beyond
        return np.where(lost[:, None], np.nan, pixels)

    def around(self, width: int, height: int) -> "ForwardCamera":
        """The camera with the field from which triangles reach into the image, some degrees wider than it.

        A fisheye lens's field grows, so that triangles at its end have whole images. A pinhole within a round gel has
        gel beside and behind it, whose images would be endless: its field ends soon after the image.
        """
        if self.is_fisheye:
            return replace(self, field=min(self.field + _WIDER, np.pi))
        if self.shell is None:
            return self
        corners = np.array([(x, y) for x in (0.0, width) for y in (0.0, height)])
        ends = cv2.undistortPoints(corners[:, None], self.matrix, self.distortion)
        return replace(self, field=min(self.field, float(np.arctan(np.linalg.norm(ends, axis=2).max())) + _WIDER))

    def is_in_field(self, points: Points, path: int) -> BoolArray:
        """Whether the lens model holds for points (n, 3) mm."""
        return np.asarray(_angle(self._local(points, path)) < self.field)

    def height(self, points: Points) -> FloatArray:
        """What falls along every ray in the body, (n,) mm: z below a flat window, nearness to a round one's axis."""
        return points[:, 2] if self.shell is None else -np.linalg.norm(self.shell.outwards(points), axis=1)

    def reaches(self, points: Points, path: int) -> BoolArray:
        """Whether light from points (n, 3) that a path shows meets its mirror, and no other mirror before or after."""
        aim = self._aim(points, path)
        free = np.asarray(np.isfinite(aim).all(axis=1))
        if path == 0:
            for plate in self.plates:
                free &= ~plate.crossed(self.eye, aim)
            return free
        own = self.plates[path - 1]
        free &= own.crossed(self.eye, aim) & bool((self.eye - own.corners[0]) @ own.normal > 0)
        turn = own.crossing(self.eye, aim)
        end = own.reflected(aim)
        for plate in self.plates:
            if plate is not own:
                free &= ~plate.crossed(self.eye, turn) & ~plate.crossed(turn, end)
        return free

    def _local(self, points: Points, path: int) -> Points:
        """Where the camera has to look, in its own right-handed frame, z ahead."""
        return np.asarray((self._aim(points, path) - self.eye) * _MIRROR @ self.rotation.T)

    def _aim(self, points: Points, path: int) -> Points:
        """Where the camera has to look, straight, to see points: the crossing of the window's face, or the points."""
        origin, up = np.array([0.0, 0.0, self.face_z]), _UP
        if path > 0:
            plate = self.plates[path - 1]
            tip = plate.reflected(origin + up)
            points, origin = plate.reflected(points), plate.reflected(origin)
            up = tip - origin
        if self.index == 1:
            return points
        if self.shell is not None:
            return self.shell.crossings(points, self.eye, self.index)
        return self._crossing(points, origin, up)

    def _crossing(self, points: Points, origin: FloatArray, up: FloatArray) -> Points:
        """Where light from points crosses a face through `origin` whose side of the air is `up`, (n, 3) mm."""
        above = float((self.eye - origin) @ up)
        below = (origin - points) @ up
        if above <= 0:
            return np.full_like(points, np.nan)
        foot = self.eye - above * up
        arm = points - foot + below[:, None] * up
        reach = np.linalg.norm(arm, axis=1)

        def slope(s: FloatArray) -> FloatArray:
            rest = reach - s
            return s / np.hypot(s, above) - self.index * rest / np.hypot(rest, below)

        with np.errstate(invalid="ignore", divide="ignore"):
            low, high = reach * above / (above + below), reach.copy()
            at_low, at_high = slope(low), slope(high)
            s = low
            for _ in range(60):
                step = np.where(at_high != at_low, at_high * (high - low) / (at_high - at_low), 0.0)
                previous, s = s, high - step
                value = slope(s)
                # The end kept is `low`; where the new value falls on the side of `high`, low's value is halved.
                crossed = value * at_high < 0
                low, at_low = np.where(crossed, high, low), np.where(crossed, at_high, at_low / 2)
                high, at_high = s, value
                if np.all(np.abs(s - previous) <= 1e-13 * reach):
                    break
        share = np.divide(s, reach, out=np.zeros_like(s), where=reach > 0)
        return foot + arm * share[:, None]


def _angle(local: Points) -> FloatArray:
    """Angles to the camera's axis, radians (n,)."""
    return np.asarray(np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2]))


def _turning_angle(camera: Camera) -> float:
    """Angle to the axis at which the image's radius first stops growing, from a table; at most the widest lens's."""
    if camera.lens == "fisheye":
        angle = np.linspace(0, np.radians(110), 200_001)
        radius = _fisheye_radius(angle, np.array(camera.distortion))
    else:
        tangent = np.linspace(0, 20, 200_001)
        angle = np.arctan(tangent)
        k1, k2, _, _, k3 = camera.distortion
        radius = tangent * (1 + k1 * tangent**2 + k2 * tangent**4 + k3 * tangent**6)
    stops = np.flatnonzero(np.diff(radius) <= 0)
    return float(angle[stops[0]]) if len(stops) else float(angle[-1]) if camera.lens == "fisheye" else np.pi / 2


def _fisheye_radius(angle: FloatArray, k: FloatArray) -> FloatArray:
    """Distances (n,) from the image's centre over the focal length, at angles (n,) to the axis."""
    return np.asarray(angle + k[0] * angle**3 + k[1] * angle**5 + k[2] * angle**7 + k[3] * angle**9)
