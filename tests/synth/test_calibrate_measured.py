"""Measured light fitted to presses: known quadratic forms are recovered, and what is written is what was fitted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from render_scenes import FAST, needs_llvm, small_sensor

from synth.arrays import FloatArray
from synth.calibrate.ball_fit import BallFit, Press
from synth.calibrate.contact import Contact
from synth.calibrate.frames import Frames
from synth.calibrate.irradiance import LightGeometry, LitGel
from synth.calibrate.lights import LightFit
from synth.calibrate.measured import FILE, FLAT, fit_measured, written
from synth.calibrate.pressed_ball import press_series
from synth.calibrate.sensor_fit import SensorFit
from synth.render.camera_image import off_centre
from synth.render.measured_light import read_measured_light
from synth.scene import Light

DIRECTIONS = np.radians([-90.0, 30.0, 150.0])
TILTS = [(0.0, 0.0)] + [(30.0, azimuth) for azimuth in range(0, 360, 45)]
CAMERA = {"width": 160, "height": 120, "fx": 265.0, "fy": 265.0, "cx": 80.0, "cy": 60.0, "gamma": 2.2}


def _brightness(place: FloatArray, normal: FloatArray) -> FloatArray:
    """(n, 3): light that grows by half toward its side, and less where the gel is tilted away from it."""
    out = np.stack([np.cos(DIRECTIONS), np.sin(DIRECTIONS)])
    slope = 0.9 * normal[:, :2] @ out - 0.3 * (normal[:, :2] @ out) ** 2
    return np.asarray(0.3 * (1 + 0.05 * place @ out) * np.maximum(normal[:, 2:] + slope, 0))


# Each slope is shown at a few places only, between which the light changes by some 5 %; a depth that is found to some
# per cent from a start of 50 % changes slopes by as much.
@needs_llvm
@pytest.mark.parametrize(("deeper", "turned", "tolerance"), [(1.0, 0.0, 0.05), (1.5, 9.0, 0.1)], ids=["known", "off"])
def test_light_on_tilted_faces_is_recovered_from_presses(
    tmp_path: Path, deeper: float, turned: float, tolerance: float
) -> None:
    """Also from presses that are taken for deeper ones, and lights whose shadows end elsewhere."""
    lights, fitted = (
        tuple(
            Light(
                position_mm=(8 * np.cos(a), 8 * np.sin(a), 2.9),
                size_mm=(0.5, 0.5),
                color=tuple(np.eye(3)[c]),
                power=300,
            )
            for c, a in enumerate(DIRECTIONS + turn)
        )
        for turn in (0, np.radians(turned))
    )
    sensor = small_sensor(1.41, None, lights, vignetting=0.2, position_mm=(0, 0, 20), look_at_mm=(0, 0, 0), **CAMERA)
    camera, presses, series = sensor.camera, [], press_series(sensor, 3.0, 1.0, 0.5)
    y, x = np.mgrid[:120, :160] + 0.5
    every = np.column_stack([x.ravel(), y.ravel()])
    flat = LitGel(sensor, every, FAST)

    def shown(gel: LitGel, pixels: FloatArray) -> FloatArray:
        light = _brightness(gel.points[:, :2], gel.normals) * (1 - 0.2 * off_centre(camera, *pixels.T))[:, None]
        return light * gel.visible(LightGeometry.of(lights)).T

    rest = shown(flat, every).reshape(120, 160, 3) ** (1 / 2.2)
    for number, place in enumerate([(-2.0, -1.2), (2.0, 1.0), (1.8, -1.4), (-1.6, 1.5), (0.0, 0.2)]):
        press = Press(
            f"b{number}", Contact((0, 0), 1), every[::61], np.zeros(0), np.zeros(0), np.array([*place, np.log(0.8)])
        )
        gel = LitGel(sensor, press.pixels, FAST, (series.surface, series.face(press.pose)))
        before, after = 255 * rest.reshape(-1, 3)[::61], 255 * shown(gel, press.pixels) ** (1 / 2.2)
        presses.append(Press(press.name, press.contact, press.pixels, before, after - before, press.pose))
    pose = presses[-1].pose
    presses = [replace(press, pose=press.pose + np.array([0, 0, np.log(deeper)])) for press in presses]
    presses[-1] = replace(
        presses[-1], pose=pose + np.array([0.2, -0.2, 0.2])
    )  # as lights that are not measured would have it
    fit = LightFit(LightGeometry.of(fitted), 300 * np.eye(3), 0.2, 0.0, 0, np.zeros((0, 3)))
    whole = SensorFit(
        sensor.model_copy(update={"lights": fitted}),
        fit,
        None,
        None,
        np.ones((120, 160), bool),
        BallFit(fit, tuple(presses), (), series),
    )
    lit, model = fit_measured(whole, Frames(rest, rest, 1 / 255), frozenset({"b4"}), FAST)
    assert lit.pressed is not None
    # Of the search, 0.01, and the light's error.
    np.testing.assert_allclose(lit.pressed.presses[-1].pose, pose, atol=1.5 * tolerance)
    for polar, azimuth in np.radians(TILTS):
        normal = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        place = np.array([(-2.5, -1.5), (2.5, 1.5), (0.0, 0.0)])
        own = _published(model, place, normal)
        assert np.abs(own - _brightness(place, np.tile(normal, (3, 1)))).max() < 0.3 * (
            tolerance / 5 if polar == 0 else tolerance
        )
    for name, content in zip((FILE, FLAT), written(model), strict=True):
        (tmp_path / name).write_bytes(content)
    read = read_measured_light(lit.sensor, tmp_path)
    assert read is not None
    np.testing.assert_allclose(read.size_mm, model.size_mm, rtol=1e-6)
    np.testing.assert_allclose(read.coefficients, model.coefficients, rtol=1e-6)
    np.testing.assert_allclose(read.flat, model.flat, rtol=0, atol=2e-5)  # 16 bits


def _published(model, place: FloatArray, n: FloatArray) -> FloatArray:
    """GelSight's formula at places (k, 2) mm for one normal, written down once more: (k, 3)."""
    found = []
    for x, y in place:
        u, v = x / min(model.size_mm), y / min(model.size_mm)
        values = []
        for light, numbers in enumerate(model.coefficients @ np.array([u * u, u * v, v * v, u, v, 1])):
            a = np.array([numbers[[0, 1, 2]], numbers[[1, 3, 4]], numbers[[2, 4, 5]]])
            rows, columns = model.flat.shape[:2]
            at = int((y / model.size_mm[1] + 0.5) * rows), int((x / model.size_mm[0] + 0.5) * columns)
            values.append(model.flat[*at, light] * (n @ a @ n + numbers[6:9] @ n + numbers[9]))
        found.append(values)
    return np.array(found)
