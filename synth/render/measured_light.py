r"""Measured light: what each LED of a real sensor gives, in place of the irradiance that follows from its geometry.

GelSight publishes it for its devices (github.com/gelsightinc/gssim, `shadeQuadratic.cpp` and `createscan.m`). With the
unit normal n toward the camera and the place (x, y), in shares of the picture's shorter side from its middle, bare
coating has in the light of one LED the intensity, full scale 1,

.. math::  I = f(x, y) \; \max(n^T A(x, y) n + b(x, y) \cdot n + c(x, y), 0) ,

where the ten numbers of A, b and c are polynomials of the place, and f is a flat field over its scale: 1 in pictures
that are corrected for it. All is as through the window, with what the gel reflects onto itself at rest, and without
shadows. The place is that on the gel; beyond the measured picture its edge holds.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Image
from synth.errors import InputError
from synth.render.albedo_map import AlbedoMap
from synth.render.aligned import aligned
from synth.render.bitmap import decoded
from synth.scene import Sensor
from synth.untrusted import MOST_TEXT, parsed, read_file

_NUMBERS = 10
"""Of A (upper triangle, row by row), b and c."""
_TERMS = tuple((degree + 1) * (degree + 2) // 2 for degree in range(7))
"""Numbers of terms of polynomials in x and y, by their degree."""
_ACROSS, _DARKEST = 3, 1 / 255
"""LEDs side by side in the picture of flat fields; its least value that counts."""


@dataclass(frozen=True, eq=False)
class LightModel:
    """Light of m LEDs: coefficients (m, 10, terms), terms by falling degree and then by falling power of x; sides of
    the measured picture, mm; flat fields over their scales (rows, columns, m).
    """

    coefficients: FloatArray
    size_mm: tuple[float, float]
    flat: Image


def read_measured_light(sensor: Sensor, folder: Path) -> LightModel | None:
    """A sensor's measured light from its files in a folder; None where it has none.

    InputError for files that are missing or of another format, and for another number of LEDs than of lights.
    """
    if sensor.measured_light is None:
        return None
    path = folder / sensor.measured_light.file
    where = f"sensor.measured_light.file: {path}"
    try:
        text = read_file(path, MOST_TEXT).decode("utf-8", "replace")
    except OSError as error:
        raise InputError(f"{where} cannot be read: {error.strerror or error}") from error
    sections = dict(re.findall(r"^(\w+):(.*?)(?=^\w|\Z)", text, re.MULTILINE | re.DOTALL))
    try:
        count, width, height = (int(sections[key]) for key in ("nL", "width", "height"))
        pitch, values = float(sections["mmperpixel"]), _numbers(sections["quadfit"], "values", where)
        coefficients = values.reshape(-1, count, _NUMBERS).transpose(1, 2, 0)
        if coefficients.shape[2] not in _TERMS or not all(0 < x < 1e6 for x in (count, width, height, pitch)):
            raise ValueError(f"{values.size} numbers in quadfit, {count} lights, {width} x {height} pixels")
        name, flat = sensor.measured_light.flat_field, np.ones((1, 1, count), np.float32)
        scale = _numbers(sections["flatfield"], "scale", where).reshape(count) if name else flat[0, 0]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where} is no light as GelSight publishes it ({error}): give a file with nL, width, height, mmperpixel, "
            f"quadfit ({_NUMBERS} columns a light) and, for a flat field, flatfield with its scale"
        ) from error
    if count != len(sensor.lights):
        raise InputError(
            f"{where} holds {count} LEDs, the scene has {len(sensor.lights)} lights: give one of sensor.lights for "
            "each LED, in their order, with power = 0 for those that are off"
        )
    size_mm = width * pitch, height * pitch
    return LightModel(coefficients, size_mm, _flat_field(folder / name, scale) if name else flat)


def _flat_field(path: Path, scale: FloatArray) -> Image:
    """Flat fields over their scales, from a picture that holds them in rows of three."""
    where = "sensor.measured_light.flat_field"
    stored, down = decoded(path, where, (np.uint8, np.uint16))[:, :, 0], -(-len(scale) // _ACROSS)
    if stored.shape[0] % down or stored.shape[1] % _ACROSS or scale.min() <= 0:
        raise InputError(f"{where}: {path} is no picture of {len(scale)} equal tiles, {_ACROSS} side by side")
    tiles = stored.reshape(down, stored.shape[0] // down, _ACROSS, -1).transpose(1, 3, 0, 2)
    fields = tiles.reshape(*tiles.shape[:2], -1)[:, :, : len(scale)] / np.iinfo(stored.dtype).max
    return (np.maximum(fields, _DARKEST) / scale).astype(np.float32)


def _numbers(section: str, key: str, where: str) -> FloatArray:
    """A list of numbers in a section; ValueError where there is none, or one is not finite."""
    found = re.search(rf"\b{key}:\s*(\[[^\[\]]*\])", section)
    values = np.array(parsed(json.loads, found[1] if found else "[]", where), dtype=np.float64)
    if not (values.size and np.isfinite(values).all()):
        raise ValueError(f"{key} is no list of finite numbers")
    return values


@dataclass(init=False, eq=False)
class MeasuredLight:
    """The light of a model's LEDs on the device: of those that the sensor's lights give power, in their order."""

    _mi: Any
    degree: int
    _coefficients: Any
    _flat: AlbedoMap
    _size: Any
    _scales: list[Any]

    def __init__(self, model: LightModel, sensor: Sensor, channels: int, mi: Any) -> None:
        import drjit as dr

        lit = [number for number, light in enumerate(sensor.lights) if light.power > 0]
        self._mi, self.degree = mi, _TERMS.index(model.coefficients.shape[2])
        self._coefficients = mi.Float(aligned(model.coefficients[lit]))
        self._flat = AlbedoMap(model.flat[:, :, lit], mi)
        self._size = mi.Vector2f(*(dr.opaque(mi.Float, side) for side in model.size_mm))
        # Rendering multiplies by albedo / pi, and by what the window lets through; both are measured with the rest.
        index = sensor.window.refractive_index
        through = (1 - ((index - 1) / (index + 1)) ** 2) / index**2
        factors = np.pi / (through * np.maximum(sensor.coating.reflectance, 1e-6))
        factors = factors * [np.multiply(sensor.lights[k].power, sensor.lights[k].color) for k in lit]
        self._scales = [mi.Float(aligned(column)) for column in factors.T[:channels]]

    def irradiance(self, number: Any, at: Any, normal: Any, active: Any) -> list[Any]:
        """Irradiance (channels of mi.Float) by an LED (mi.UInt32), unshaded, at points with unit normals."""
        import drjit as dr

        mi = self._mi
        share = dr.clip(mi.Vector2f(at.p.x, -at.p.y) / self._size, -0.5, 0.5)
        x, y = share * self._size / dr.minimum(self._size.x, self._size.y)
        n, m, o = normal.x, -normal.y, normal.z  # in the scene's frame
        forms = (n * n, 2 * n * m, 2 * n * o, m * m, 2 * m * o, o * o, n, m, o, mi.Float(1))
        value, index = mi.Float(0), number * (_NUMBERS * _TERMS[self.degree])
        for form in forms:
            coefficient = mi.Float(0)
            for degree in range(self.degree, -1, -1):
                for power in range(degree, -1, -1):
                    term = dr.gather(mi.Float, self._coefficients, index, active)
                    coefficient += term * x**power * y ** (degree - power)
                    index = index + 1
            value = dr.fma(coefficient, form, value)
        (flat,) = self._flat.at(share + 0.5, active, [number])
        value = flat * dr.maximum(value, 0)
        return [value * dr.gather(mi.Float, scale, number, active) for scale in self._scales]
