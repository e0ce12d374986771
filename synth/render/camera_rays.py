r"""Rays through the camera's pixels, for Mitsuba.

Vectorised variants get every lens and mirror exactly: rays are made here and start inside the body, refracted by
Snell's law at the window's face and weighted by

.. math::  \frac{1 - F(\theta)}{n^2},

Fresnel's transmittance for unpolarised light and the radiance law for the passage between media. That is what a path
tracer finds on average behind a smooth dielectric, without its noise. With an aperture (`synth.render.thin_lens`) each
ray starts at its own point of the pupil.

Scalar variants trace far too slowly from Python and use Mitsuba's own pinhole camera, which knows square pixels and no
lens distortion, fisheye, mirror, aperture or round window.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.optics import Optics
from synth.optics.mirror import FlatMirror
from synth.optics.window import RoundWindow
from synth.render.aligned import aligned
from synth.render.gel_mesh import MIRROR
from synth.render.thin_lens import ThinLens
from synth.render.variant import LLVM_HINT
from synth.scene import Camera, Sensor

_START_MM = 1e-3
"""How far inside the window's face rays start, so that rounding cannot put them outside."""


@dataclass(init=False, eq=False)
class CameraRays:
    """Primary rays of a vectorised variant. Every number is opaque to Dr.Jit, so that no camera is recorded anew."""

    _mi: Any
    _dr: Any
    _width: Any
    _focal: list[Any]
    _centre: list[Any]
    _right: Any
    _down: Any
    _forward: Any
    _position: Any
    _mirrors: list["_Mirror"]
    _refracts: bool
    _index: Any
    _round: "RoundWindowFace | None"
    _face: Any
    _is_fisheye: bool
    _distortion: list[Any] | None
    _radius: Any
    _focus: Any
    _seen: Any = None
    _start: Any = None

    def __init__(self, sensor: Sensor, mi: Any) -> None:
        import drjit as dr

        optics, camera = Optics.of(sensor), sensor.camera
        self._mi, self._dr, self._width = mi, dr, dr.opaque(mi.UInt32, camera.width)
        self._focal = [dr.opaque(mi.Float, value) for value in optics.lens.focal]
        self._centre = [dr.opaque(mi.Float, value) for value in optics.lens.centre]
        pose = optics.pose
        axes = (pose.right, pose.down, pose.forward, pose.position)
        self._right, self._down, self._forward, self._position = (self._vector(axis) for axis in axes)
        self._mirrors = [_Mirror(mirror, self._vector, mi, dr) for mirror in optics.mirrors]
        window = optics.window
        self._refracts = window.index != 1
        self._index = dr.opaque(mi.Float, window.index)
        self._round = RoundWindowFace(window, mi) if isinstance(window, RoundWindow) else None
        self._face = None if isinstance(window, RoundWindow) else dr.opaque(mi.Float, window.face_z)
        self._is_fisheye = camera.lens == "fisheye"
        self._distortion = [dr.opaque(mi.Float, k) for k in camera.distortion] if any(camera.distortion) else None
        thin = ThinLens.of(sensor)
        self._radius = dr.opaque(mi.Float, thin.radius_mm) if thin else None
        self._focus = dr.opaque(mi.Float, thin.distance_mm) if thin else None
        if self._distortion is not None or self._is_fisheye:
            local = _centres(optics, camera)
            self._seen = mi.Bool(aligned(np.isfinite(local[:, 0]), np.bool_))
            start = np.nan_to_num(local).astype(np.float32)
            self._start = [mi.Float(aligned(start[:, axis])) for axis in range(start.shape[1])]

    def _vector(self, vector: FloatArray) -> Any:
        """A vector (3,) of the scene in the renderer's frame."""
        mi, dr = self._mi, self._dr
        return mi.Vector3f(*(dr.opaque(mi.Float, value) for value in vector * MIRROR))

    @property
    def static(self) -> tuple[Any, ...]:
        """What of the camera is compiled into kernels."""
        optional = (self._round, self._distortion, self._radius)
        return self._refracts, self._is_fisheye, len(self._mirrors), *(value is None for value in optional)

    @property
    def has_aperture(self) -> bool:
        """Whether `sample` needs points of a pupil; without an aperture none may be drawn for it."""
        return self._radius is not None

    def sample(self, pixel: Any, offset: Any, pupil: Any | None = None) -> tuple[Any, Any, Any]:
        """Rays (mi.RayDifferential3f) through points of pixels, weights (mi.Float), and whether the lens looks there.

        `pixel` is mi.UInt32, row-major; `offset` (mi.Point2f in [0, 1)²) the point within the pixel (right, down).
        `pupil`, likewise, is made into a uniform point of the pupil; None: its centre, the pinhole.
        """
        mi, dr = self._mi, self._dr
        column, row = pixel % self._width, pixel // self._width
        x = (mi.Float(column) - self._centre[0] + offset.x) / self._focal[0]
        y = (mi.Float(row) - self._centre[1] + offset.y) / self._focal[1]
        valid = mi.Bool(True)
        forward = self._forward
        if self._is_fisheye:
            valid = dr.gather(mi.Bool, self._seen, pixel)
            x, y, along = self._unbend(pixel, x, y)
            forward = forward * along
        elif self._distortion is not None:
            valid = dr.gather(mi.Bool, self._seen, pixel)
            x, y = self._undistort(pixel, x, y)
        eye = self._position
        if pupil is not None:
            point = mi.warp.square_to_uniform_disk_concentric(pupil) * self._radius
            eye = eye + self._right * point.x + self._down * point.y
            x, y = x - point.x / self._focus, y - point.y / self._focus
        air = dr.normalize(self._right * x + self._down * y + forward)
        if self._mirrors:
            eye, air, unhindered = self._reflect(eye, air)
            valid &= unhindered
        if not self._refracts:
            return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(eye), air)), mi.Float(1), valid
        if self._round is not None:
            origin, inside, slant, meets = self._round.enter(eye, air)
        else:
            slant, meets = -air.z, air.z < 0
            origin = eye + air * ((self._face - eye.z) / air.z)
            origin.z = self._face
            across = mi.Vector2f(air.x, air.y) / self._index
            inside = mi.Vector3f(across.x, across.y, -dr.sqrt(dr.maximum(1 - dr.squared_norm(across), 0)))
        reflected, *_ = mi.fresnel(slant, self._index)
        ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(origin + inside * _START_MM), inside))
        return ray, (1 - reflected) / dr.square(self._index), valid & meets

    def _reflect(self, eye: Any, air: Any) -> tuple[Any, Any, Any]:
        """Where rays in air from `eye` start after their mirror, their directions, and whether they may go on.

        The rules are those of `synth.optics.mirror.first_met`, for every sample by itself: a pixel on a mirror's edge
        sees both sides.
        """
        mi, dr = self._mi, self._dr
        start, onward = mi.Vector3f(eye), mi.Vector3f(air)
        nearest, which, free = mi.Float(dr.inf), mi.UInt32(0), mi.Bool(True)
        for number, mirror in enumerate(self._mirrors, 1):
            distance, facing = mirror.met(eye, air)
            closer = distance < nearest
            nearest, which = dr.select(closer, distance, nearest), dr.select(closer, number, which)
            free = dr.select(closer, facing, free)
            start = dr.select(closer, eye + air * distance, start)
            onward = dr.select(closer, air - 2 * dr.dot(air, mirror.normal) * mirror.normal, onward)
        for number, mirror in enumerate(self._mirrors, 1):
            free &= (which == 0) | (which == number) | ~dr.isfinite(mirror.met(start, onward)[0])
        return start, onward, free

    def _unbend(self, pixel: Any, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """Direction through a fisheye lens: Newton from the pixel centre's angle, as `_undistort`."""
        dr = self._dr
        radius = dr.sqrt(x * x + y * y)
        angle = radius
        if self._distortion is not None:
            k1, k2, k3, k4 = self._distortion
            angle = dr.gather(type(x), self._start[2], pixel)
            for _ in range(2):
                s = angle * angle
                miss = angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4)))) - radius
                angle = angle - miss / (1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4))))
        scale = dr.select(radius > 1e-6, dr.sin(angle) / radius, 1)
        return x * scale, y * scale, dr.cos(angle)

    def _undistort(self, pixel: Any, x: Any, y: Any) -> tuple[Any, Any]:
        """Newton from the pixel centre's solution: two steps leave (half a pixel / f)⁴, below float32's rounding."""
        k1, k2, p1, p2, k3 = self._distortion  # type: ignore[misc]
        u, v = (self._dr.gather(type(x), start, pixel) for start in self._start)
        for _ in range(2):
            s = u * u + v * v
            radial = 1 + s * (k1 + s * (k2 + s * k3))
            slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
            error_x = u * radial + 2 * p1 * u * v + p2 * (s + 2 * u * u) - x
            error_y = v * radial + p1 * (s + 2 * v * v) + 2 * p2 * u * v - y
            xx = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u
            yy = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
            xy = u * v * slope + 2 * p1 * u + 2 * p2 * v
            determinant = xx * yy - xy * xy
            u = u - (yy * error_x - xy * error_y) / determinant
            v = v - (xx * error_y - xy * error_x) / determinant
        return u, v


@dataclass(init=False, eq=False)
class _Mirror:
    """A mirror of `synth.optics.mirror` in the renderer's frame, opaque to Dr.Jit."""

    centre: Any
    normal: Any
    axes: list[Any]
    half: list[Any]
    _dr: Any

    def __init__(self, mirror: FlatMirror, vector: Callable[[FloatArray], Any], mi: Any, dr: Any) -> None:
        self._dr, self.centre, self.normal = dr, vector(mirror.centre), vector(mirror.normal)
        self.axes = [vector(axis) for axis in mirror.axes]
        self.half = [dr.opaque(mi.Float, value) for value in mirror.half]

    def met(self, origin: Any, direction: Any) -> tuple[Any, Any]:
        """How far rays go to the mirror, infinite where they miss it, and whether they meet its front."""
        dr = self._dr
        slope = dr.dot(direction, self.normal)
        distance = dr.dot(self.centre - origin, self.normal) / slope
        arm = origin + direction * distance - self.centre
        hit = distance > 0
        for axis, half in zip(self.axes, self.half, strict=True):
            hit &= dr.abs(dr.dot(arm, axis)) <= half
        return dr.select(hit, distance, dr.inf), slope < 0


@dataclass(init=False, eq=False)
class RoundWindowFace:
    """The round inner face of `synth.optics.window` in the renderer's frame, opaque to Dr.Jit."""

    _mi: Any
    _dr: Any
    _index: Any
    _radius: Any
    _low: Any
    _high: Any

    def __init__(self, window: RoundWindow, mi: Any) -> None:
        import drjit as dr

        self._mi, self._dr = mi, dr
        values = (window.index, window.radius, window.low, window.high)
        self._index, self._radius, self._low, self._high = (dr.opaque(mi.Float, value) for value in values)

    def enter(self, eye: Any, air: Any) -> tuple[Any, Any, Any, Any]:
        """Follow rays in air from within, with unit directions, through the face.

        Where they meet it, their unit directions beyond it, the cosine of their angle to the normal in air, and whether
        they meet it at all.
        """
        dr = self._dr
        level = self._mi.Vector2f(air.x, air.y)
        square, half = dr.squared_norm(level), air.x * eye.x + air.y * eye.y
        rest = eye.x * eye.x + eye.y * eye.y - dr.square(self._radius)
        side = dr.select(square > 1e-12, _far_root(square, half, rest), dr.inf)
        height = eye.z + side * air.z
        end = dr.clip(height, self._low, self._high)
        arm = self._mi.Vector3f(eye.x, eye.y, eye.z - end)
        cap = _far_root(1, dr.dot(arm, air), dr.squared_norm(arm) - dr.square(self._radius))
        distance = dr.select(height == end, side, cap)
        place = eye + air * distance
        foot = dr.clip(place.z, self._low, self._high)
        normal = self._mi.Vector3f(place.x, place.y, place.z - foot) / self._radius
        slant = dr.dot(air, normal)
        bent = dr.sqrt(dr.maximum(1 - (1 - dr.square(slant)) / dr.square(self._index), 0))
        inside = dr.normalize(air / self._index + normal * (bent - slant / self._index))
        return place, inside, slant, dr.isfinite(distance)


def _far_root(square: Any, half: Any, rest: Any) -> Any:
    """The larger root of square t² + 2 half t + rest = 0 with a rest below 0, without cancellation."""
    import drjit as dr

    root = dr.sqrt(dr.square(half) - square * rest)
    return dr.select(half > 0, -rest / (half + root), (root - half) / square)


def pinhole(sensor: Sensor) -> dict[str, Any]:
    """Mitsuba's perspective camera, less its film and sampler, for scalar variants.

    InputError for a fisheye lens, a mirror, distortion, an aperture, pixels that are not square, a round window before
    the camera, or a light that is narrower than Lambertian.
    """
    optics, camera = Optics.of(sensor), sensor.camera
    need = f"needs LLVM 16 or newer, or an NVIDIA GPU, which this machine lacks ({LLVM_HINT})"
    is_round = isinstance(optics.window, RoundWindow) and optics.window.index != 1
    if camera.lens != "pinhole" or sensor.mirrors or is_round:
        what = "sensor.mirrors" if sensor.mirrors else f"sensor.camera.lens = {camera.lens!r}"
        what = f"sensor.window.shape = {sensor.window.shape!r}" if is_round else what
        raise InputError(f"{what} {need}; there is no way to render it without")
    if any(camera.distortion):
        raise InputError(
            f"sensor.camera.distortion = {list(camera.distortion)} {need}; without, set it to [0, 0, 0, 0, 0]"
        )
    if camera.aperture_mm:
        raise InputError(f"sensor.camera.aperture_mm = {camera.aperture_mm} {need}; without, set it to 0, a pinhole")
    if camera.fx != camera.fy:
        raise InputError(
            f"sensor.camera.fx = {camera.fx} and fy = {camera.fy} differ, which {need}; without, make them equal"
        )
    for light in sensor.lights:
        if light.narrowness:
            raise InputError(f"viewing_angle_deg = {light.viewing_angle_deg} of a light {need}; without, set it to 120")
    frame = np.eye(4)
    # Mitsuba's camera looks along its z axis, with x to the left and y up.
    pose = optics.pose
    frame[:3] = np.column_stack([-pose.right, -pose.down, pose.forward, pose.position]) * MIRROR[:, None]
    return {
        "type": "perspective",
        "to_world": frame.tolist(),
        "fov_axis": "x",
        "fov": 2 * math.degrees(math.atan(camera.width / (2 * camera.fx))),
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
        "near_clip": 1e-2,
        "far_clip": 1e4,
    }


def _centres(optics: Optics, camera: Camera) -> FloatArray:
    """Where Newton's method starts, at pixel centres: undistorted x, y and, for a fisheye lens, the angle to the axis.

    (H·W, 2) or (H·W, 3) float64, NaN where the lens does not look.
    """
    local = optics.local
    if camera.lens == "fisheye":
        return np.column_stack([local[:, :2], np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])])
    return local[:, :2] / local[:, 2:]
