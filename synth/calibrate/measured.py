r"""Measured light (`synth.render.measured_light`) of each channel, fitted to a gel at rest and to presses of a ball.

At the place x with the normal n, the channel c of the bare coating has the radiance

.. math::  L_c(x, n) = f_c(x) \, V_c \, q_c(x, n) , \qquad q = n^T A(x) n + b(x) \cdot n + c(x) ,

where f is that of the gel at rest, so that q is 1 there, and V tells whether the lead of the channel, the one of its
fitted lights that gives most, is seen from x. The coefficients of A, b and c, quadratic in x, solve a linear problem of
least squares with a weak prior at 0: what the presses do not show stays small.
"""

from dataclasses import replace

import cv2
import numpy as np

from synth.arrays import FloatArray
from synth.calibrate.ball_fit import BallFit, Balls
from synth.calibrate.frames import Frames
from synth.calibrate.irradiance import LightGeometry, LitGel
from synth.calibrate.sensor_fit import SensorFit, smoothed
from synth.dataset.images import encode_png
from synth.optics import Optics
from synth.render.camera_image import off_centre
from synth.render.measured_light import LightModel
from synth.render.variant import Variant
from synth.scene import MeasuredLight, Sensor

FILE, FLAT = "measured_light.yaml", "measured_light.png"
_DEGREE, _PRIOR, _AT_REST = 2, 0.01, 0.1
"""Degree in the place; weights of the prior of each coefficient, and of q = 1 at rest, as of encoded pixels."""
_FORMS, _COARSE = 10, 2
"""Numbers of A, b and c; px a texel of the flat field."""


def fit_measured(fit: SensorFit, frames: Frames, balls: Balls, variant: Variant) -> tuple[SensorFit, LightModel]:
    """The fitted sensor with its light measured, and that light; `fit` is of the frames, and of the balls' presses."""
    assert fit.pressed is not None
    sensor, gamma = fit.sensor, fit.sensor.camera.gamma
    lead = _leads(fit, variant)
    place = LightGeometry.of([fit.sensor.lights[k] for k in lead])
    side = _side(sensor)
    seen, told = [], []
    for press in fit.pressed.presses:
        ball = press.ball(sensor, balls)
        gel = LitGel(sensor, press.pixels, variant, (ball.surface, ball.positions))
        seen.append((gel.visible(place)[..., None], _basis(gel.points[:, :2] / side.min(), gel.normals)))
        rest, after = (np.clip(level / 255, 2 / 255, 1) for level in (press.rest, press.rest + press.changed))
        told.append((rest**gamma, after**gamma, (after ** (1 - gamma) / gamma) * (after < 253 / 255)))
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.7, 0.7, 8)]), axis=-1).reshape(-1, 2)
    still = _basis(grid, np.tile([0.0, 0.0, 1.0], (len(grid), 1)))
    used = [k for k, press in enumerate(fit.pressed.presses) if press.name not in balls.judged]
    found = []
    for channel in range(3):
        rows, values = [_AT_REST * still, _PRIOR * np.eye(still.shape[1])], [np.full(len(still), _AT_REST)]
        values.append(np.zeros(still.shape[1]))
        for k in used:
            (visible, basis), (rest, after, slope) = seen[k], (each[:, channel] for each in told[k])
            rows.append((slope * rest)[:, None] * visible[channel] * basis)
            values.append(slope * after)
        found.append(np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0])
    model = LightModel(
        np.reshape(found, (3, _FORMS, -1)), (float(side[0]), float(side[1])), _flat(sensor, frames, fit, side)
    )
    changed = []
    for press, (visible, basis), (rest, _, _) in zip(fit.pressed.presses, seen, told, strict=True):
        value = rest * (visible[..., 0] * np.maximum(np.array(found) @ basis.T, 0)).T
        changed.append(255 * value ** (1 / gamma) - press.rest)
    lights = [sensor.lights[k].model_copy(update={"power": 1.0, "color": tuple(np.eye(3)[c].tolist())})
              for c, k in enumerate(lead)]  # fmt: skip
    lit = sensor.model_copy(
        update={"lights": tuple(lights), "measured_light": MeasuredLight(file=FILE, flat_field=FLAT)}
    )
    pressed = BallFit(fit.lights, fit.pressed.presses, tuple(changed))
    return replace(fit, sensor=lit, pressed=pressed), model


def written(model: LightModel) -> tuple[bytes, bytes]:
    """The YAML file and the picture of flat fields, three side by side, that `read_measured_light` reads."""
    peak = model.flat.max(axis=(0, 1))
    tiles = np.round(model.flat / peak * 65535).astype(np.uint16)
    width = tiles.shape[1] * _COARSE
    pitch = model.size_mm[0] / width
    values = ", ".join(f"{value:.8g}" for value in model.coefficients.transpose(2, 0, 1).ravel())
    text = f"""version: 3.0
nL: 3
width: {width}
height: {tiles.shape[0] * _COARSE}
mmperpixel: {pitch:.10g}
quadfit:
    rows: {model.coefficients.shape[2]}
    cols: {3 * _FORMS}
    values: [{values}]
flatfield:
    modelfile: {FLAT}
    scale: [{", ".join(f"{1 / value:.8g}" for value in peak)}]
"""
    return text.encode(), encode_png(np.hstack(list(tiles.transpose(2, 0, 1))))


def _leads(fit: SensorFit, variant: Variant) -> list[int]:
    """For each channel, the number of the light that gives the gel's middle most."""
    camera = fit.sensor.camera
    gel = LitGel(fit.sensor, np.array([[camera.width / 2, camera.height / 2]]), variant)
    given = gel.contributions(LightGeometry.of(fit.sensor.lights))[:, 0]
    return [
        int(k) for k in (given * [np.multiply(light.power, light.color) for light in fit.sensor.lights]).argmax(axis=0)
    ]


def _side(sensor: Sensor) -> FloatArray:
    """Sides (2,) in mm of the least rectangle around the origin that holds what the camera sees of the gel at rest."""
    camera = sensor.camera
    u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    seen = Optics.of(sensor).look(np.column_stack([u.ravel(), v.ravel()])).on_flat_face[:, :2]
    wide = np.minimum(2 * np.nanmax(np.abs(seen), axis=0), sensor.gel.size_mm[:2])
    texel = wide[0] / (camera.width // _COARSE)
    return np.array([wide[0], texel * round(wide[1] / texel)])


def _flat(sensor: Sensor, frames: Frames, fit: SensorFit, side: FloatArray) -> FloatArray:
    """Radiance (rows, columns, 3) of the gel at rest on a rectangle of its face."""
    camera, columns = sensor.camera, sensor.camera.width // _COARSE
    rows = round(columns * side[1] / side[0])
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns - 0.5, (np.arange(rows) + 0.5) / rows - 0.5)
    at = np.column_stack([x.ravel() * side[0], y.ravel() * side[1], np.zeros(x.size)])
    pixels = (Optics.of(sensor).project(at) - 0.5).astype(np.float32).reshape(rows, columns, 2)
    linear = smoothed(frames.encoded, fit.bare) ** camera.gamma
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    linear /= camera.exposure * (1 - camera.vignetting * off_centre(camera, u, v))[:, :, None]
    return np.asarray(cv2.remap(linear.astype(np.float32), pixels, None, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE))


def _basis(place: FloatArray, normal: FloatArray) -> FloatArray:
    """(n, 10 terms): forms of normals (n, 3), each times the terms in places (n, 2), as `LightModel` has them."""
    x, y = place.T
    n, m, o = normal.T
    terms = [x**power * y ** (degree - power) for degree in range(_DEGREE, -1, -1) for power in range(degree, -1, -1)]
    forms = np.stack([n * n, 2 * n * m, 2 * n * o, m * m, 2 * m * o, o * o, n, m, o, np.ones_like(n)])
    return np.asarray(np.einsum("fn,tn->nft", forms, np.stack(terms)).reshape(len(place), -1))
