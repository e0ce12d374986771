r"""Rays through the camera's pixels, for Mitsuba.

Vectorised variants get every lens exactly: rays are made here and start inside the body, refracted by Snell's law at
the window's outer face and weighted by

.. math::  \frac{1 - F(\theta)}{n^2},

Fresnel's transmittance for unpolarised light and the radiance law for the passage between media. That is what a path
tracer finds on average behind a smooth dielectric, without its noise.

Scalar variants trace far too slowly from Python and use Mitsuba's own pinhole camera, which knows square pixels and no
lens distortion.
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from synth.arrays import Pixels
from synth.errors import InputError
from synth.optics import Optics
from synth.render.gel_mesh import MIRROR
from synth.render.variant import LLVM_HINT
from synth.scene import Camera, Sensor

_START_MM = 1e-3
"""How far inside the window's face rays start, so that rounding cannot put them outside."""


class CameraRays:
    """Primary rays of a vectorised variant. Every number is opaque to Dr.Jit, so that no camera is compiled anew."""

    def __init__(self, sensor: Sensor, mi: Any) -> None:
        import drjit as dr

        optics, camera = Optics.of(sensor), sensor.camera
        self._mi, self._dr, self._width = mi, dr, dr.opaque(mi.UInt32, camera.width)
        self._focal = [dr.opaque(mi.Float, value) for value in optics.focal]
        self._centre = [dr.opaque(mi.Float, value) for value in optics.centre]
        axes = (optics.right, optics.down, optics.forward, optics.position)
        self._right, self._down, self._forward, self._position = (
            mi.Vector3f(*(dr.opaque(mi.Float, value) for value in axis * MIRROR)) for axis in axes
        )
        self._refracts = optics.index != 1
        self._index = dr.opaque(mi.Float, optics.index)
        self._face = dr.opaque(mi.Float, optics.face_z)
        self._distortion = [dr.opaque(mi.Float, k) for k in optics.distortion] if any(optics.distortion) else None
        if self._distortion is not None:
            undistorted = _undistorted_centres(optics, camera)
            self._seen = mi.Bool(np.isfinite(undistorted[:, 0]))
            start = np.nan_to_num(undistorted).astype(np.float32)
            self._start = [mi.Float(np.ascontiguousarray(start[:, axis])) for axis in (0, 1)]

    def sample(self, pixel: Any, offset: Any) -> tuple[Any, Any, Any]:
        """Rays through points of pixels.

        Args:
            pixel: mi.UInt32, row-major index of the pixel.
            offset: mi.Point2f in [0, 1)², the point within the pixel (right, down).

        Returns:
            Ray (mi.RayDifferential3f), weight (mi.Float) and whether the lens looks there at all (mi.Bool).
        """
        mi, dr = self._mi, self._dr
        column, row = pixel % self._width, pixel // self._width
        x = (mi.Float(column) - self._centre[0] + offset.x) / self._focal[0]
        y = (mi.Float(row) - self._centre[1] + offset.y) / self._focal[1]
        valid = mi.Bool(True)
        if self._distortion is not None:
            valid = dr.gather(mi.Bool, self._seen, pixel)
            x, y = self._undistort(pixel, x, y)
        air = dr.normalize(self._right * x + self._down * y + self._forward)
        if not self._refracts:
            return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(self._position), air)), mi.Float(1), valid
        valid &= air.z < 0
        origin = self._position + air * ((self._face - self._position.z) / air.z)
        origin.z = self._face
        across = mi.Vector2f(air.x, air.y) / self._index
        inside = mi.Vector3f(across.x, across.y, -dr.sqrt(dr.maximum(1 - dr.squared_norm(across), 0)))
        reflected, *_ = mi.fresnel(-air.z, self._index)
        ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(origin + inside * _START_MM), inside))
        return ray, (1 - reflected) / dr.square(self._index), valid

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


def pinhole(sensor: Sensor) -> dict[str, Any]:
    """Mitsuba's perspective camera, less its film and sampler, for scalar variants.

    Raises:
        InputError: the camera has distortion or pixels that are not square.
    """
    optics, camera = Optics.of(sensor), sensor.camera
    need = f"needs LLVM 16 or newer, or an NVIDIA GPU, which this machine lacks ({LLVM_HINT})"
    if any(camera.distortion):
        raise InputError(
            f"sensor.camera.distortion = {list(camera.distortion)} {need}; without, set it to [0, 0, 0, 0, 0]"
        )
    if camera.fx != camera.fy:
        raise InputError(
            f"sensor.camera.fx = {camera.fx} and fy = {camera.fy} differ, which {need}; without, make them equal"
        )
    frame = np.eye(4)
    # Mitsuba's camera looks along its z axis, with x to the left and y up.
    frame[:3] = np.column_stack([-optics.right, -optics.down, optics.forward, optics.position]) * MIRROR[:, None]
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


def _undistorted_centres(optics: Optics, camera: Camera) -> Pixels:
    """(H·W, 2) undistorted, normalised image coordinates of the pixel centres; NaN where the lens does not look."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    _, air = replace(optics, index=1.0).rays(np.column_stack([columns.ravel(), rows.ravel()]))
    along = air @ optics.forward
    return np.column_stack([(air @ optics.right) / along, (air @ optics.down) / along])
