r"""Measured light (`synth.render.measured_light`) of each channel, fitted to a gel at rest and to presses of a ball.

At the place x with the normal n, the channel c of the bare coating has the radiance

.. math::  L_c(x, n) = f_c(x) \, V_c \, q_c(x, n) , \qquad q = n^T A(x) n + b(x) \cdot n + c(x) ,

where f is that of the gel at rest, so that q is 1 there, and V tells whether the lead of the channel, the one of its
fitted lights that gives most, is seen from x. The coefficients of A, b and c, quadratic in x, solve a linear problem of
least squares with a weak prior at 0: what the presses do not show stays small.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

import cv2
import numpy as np

from synth.arrays import FloatArray, Image
from synth.calibrate.ball_fit import BallFit, Press, placed
from synth.calibrate.frames import Frames
from synth.calibrate.irradiance import LightGeometry, LitGel
from synth.calibrate.sensor_fit import SensorFit, room_of, smoothed
from synth.dataset.images import encode_png
from synth.optics import Optics
from synth.render.camera_image import off_centre
from synth.render.measured_light import LightModel
from synth.render.variant import Variant
from synth.scene import Light, MeasuredLight, Sensor

FILE, FLAT = "measured_light.yaml", "measured_light.png"
_DEGREE, _PRIOR, _STEPS, _MOVE = 2, 0.01, 2, 0.05
"""Degree in the place; weight of the coefficients' prior, as of encoded values of pixels; steps of places and depths,
and by how much these are moved to see what it changes."""
_PLACES = (0.0, -12.0, 12.0), (0.15, 0.25, 0.35, 0.45, 0.6, 0.8), (1.0, 0.3, 0.05)
"""Turns (degrees), heights over the body's and shares of their sizes, at which lights that throw shadows are sought."""
_SHIFTS = ((0.0, -0.6, -0.45, -0.3, -0.15, 0.15, 0.3), *3 * ((0.0, -0.1, 0.1),))
"""What is added to the logarithm of all depths, in rounds: shadows widen the circles that tell depths."""
_MOVES = (0.0, -6.0, 6.0), (1.0, 0.8, 1.25), (1.0, 0.8, 1.25)
"""How far lights are turned (degrees), and shares of distance and height, from the second round on."""
_OUTLIER, _REWEIGHTED = 0.03, 3
"""Misfit of an encoded value beyond which it counts little, as where a shadow ends elsewhere; rounds that tell it."""
_FORMS, _COARSE = 10, 1
"""Numbers of A, b and c; px a texel of the flat field."""


def fit_measured(
    fit: SensorFit, frames: Frames, judged: frozenset[str], variant: Variant
) -> tuple[SensorFit, LightModel]:
    """The fitted sensor with its light measured, and that light; `fit` is of the frames, and of the balls' presses.

    Places and depths of the presses are found anew, together with the light: what lights could not describe, they met
    with other depths.
    """
    assert fit.pressed is not None
    sensor, gamma, series = fit.sensor, fit.sensor.camera.gamma, fit.pressed.series
    side, told = _side(sensor), [press for press in fit.pressed.presses if press.name not in judged]

    def rows(press: Press, lights: Sequence[Light]) -> FloatArray:
        """(m, n, 10 terms): what each coefficient of the lights' channels adds at the press's pixels, linear."""
        gel = LitGel(sensor, press.pixels, variant, (series.surface, series.face(press.pose)))
        weight = gel.visible(LightGeometry.of(lights)) * np.tile(_linear(press.rest, gamma).T, (len(lights) // 3, 1))
        return weight[..., None] * _basis(gel.points[:, :2] / side.min(), gel.normals)

    leads, body = _leads(fit, variant), sensor.gel.size_mm[2] + sensor.window.thickness_mm
    tried = leads + [_moved(lead, sensor, turn, 1, share * body, size) for turn, share, size in product(*_PLACES)
                     for lead in leads]  # fmt: skip
    for shifts in _SHIFTS:
        found = []
        for moved in (
            [replace(press, pose=press.pose + np.array([0, 0, shift])) for press in told] for shift in shifts
        ):
            parts = np.concatenate([rows(press, tried) for press in moved], axis=1)
            missed = np.array([np.sum(_solve([parts[k : k + 3]], moved, gamma)[1].reshape(3, -1) ** 2, axis=1)
                               for k in range(0, len(tried), 3)])  # fmt: skip
            picked = [tried[3 * best + channel] for channel, best in enumerate(np.argmin(missed, axis=0))]
            found.append((float(missed.min(axis=0).sum()), moved, picked))
        _, told, leads = min(found, key=lambda each: each[0])
        told, coefficients = _solved(told, partial(rows, lights=leads), gamma)
        tried = [_moved(lead, sensor, turn, out, up * lead.position_mm[2], 1) for turn, out, up in product(*_MOVES)
                 for lead in leads]  # fmt: skip

    def changed(press: Press) -> FloatArray:
        value = np.maximum(np.einsum("cnk,ck->nc", rows(press, leads), coefficients), 0)
        return np.asarray(255 * value ** (1 / gamma) - press.rest)

    at = {press.name: press for press in told}
    presses = tuple(at.get(press.name) or placed(press, changed) for press in fit.pressed.presses)
    lights = [light.model_copy(update={"power": 1.0, "color": tuple(np.eye(3)[c].tolist())})
              for c, light in enumerate(leads)]  # fmt: skip
    measured = MeasuredLight(file=FILE, flat_field=FLAT)
    lit = sensor.model_copy(update={"lights": tuple(lights), "measured_light": measured})
    model = LightModel(
        coefficients.reshape(3, _FORMS, -1), (float(side[0]), float(side[1])), _flat(sensor, frames, fit, side)
    )
    return replace(fit, sensor=lit, pressed=BallFit(fit.lights, presses, tuple(map(changed, presses)), series)), model


def _solved(presses: list[Press], rows: Callable[[Press], FloatArray], gamma: float) -> tuple[list[Press], FloatArray]:
    """Presses at their best places and depths, and the coefficients (3, 10 terms).

    Gauss-Newton steps of places and depths, of what the best coefficients leave (Kaufman's, as in
    `synth.calibrate.lights`).
    """
    slope = _slope(presses, gamma)
    parts = [rows(press) for press in presses]
    coefficients, missed, spans = _solve(parts, presses, gamma)
    for _ in range(_STEPS):
        columns = []
        for number, press in enumerate(presses):
            first = sum(part.shape[1] for part in parts[:number])
            for axis in range(3):
                moved = rows(replace(press, pose=press.pose + _MOVE * np.eye(3)[axis]))
                change = np.einsum("cnk,ck->cn", moved - parts[number], coefficients) / _MOVE
                column = []
                for channel, (weight, span) in enumerate(spans):
                    whole = np.zeros(len(span))
                    at = slice(first, first + change.shape[1])
                    whole[at] = change[channel] * slope[at, channel] * weight[at]
                    column.append(whole - span @ (span.T @ whole))
                columns.append(np.concatenate(column))
        jacobian = np.column_stack(columns)
        step = np.linalg.lstsq(jacobian, -missed, rcond=1e-3)[0].reshape(-1, 3)
        for length in (1.0, 0.5, 0.25):
            tried = [replace(press, pose=press.pose + length * np.clip(by, -0.3, 0.3))
                     for press, by in zip(presses, step, strict=True)]  # fmt: skip
            others = [rows(press) for press in tried]
            result = _solve(others, tried, gamma)
            if np.sum(result[1] ** 2) < np.sum(missed**2):
                presses, parts, (coefficients, missed, spans) = tried, others, result
                break
        else:
            break
    return presses, coefficients


def _solve(
    parts: list[FloatArray], presses: list[Press], gamma: float
) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """Coefficients, misfit (3 n,), and by channel its weights and the span of what coefficients can make.

    `parts` are the rows (3, n, 10 terms) of each press. The misfit r counts as r² / (1 + (r / 0.03)²) (Geman and
    McClure), found by weights that are taken from the last solution.
    """
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.7, 0.7, 8)]), axis=-1).reshape(-1, 2)
    still = _basis(grid, np.tile([0.0, 0.0, 1.0], (len(grid), 1)))
    slope = _slope(presses, gamma)
    wanted = slope * np.vstack([_linear(press.rest + press.changed, gamma) for press in presses])
    basis = np.concatenate(parts, axis=1) * slope.T[..., None]
    found, missed, spans = [], [], []
    for channel in range(3):
        matrix = np.vstack([basis[channel], still, _PRIOR * np.eye(still.shape[1])])
        value = np.concatenate([wanted[:, channel], np.ones(len(still)), np.zeros(still.shape[1])])
        weight, seen = np.ones(len(matrix)), np.arange(len(matrix)) < len(wanted)
        for _ in range(_REWEIGHTED):
            span, triangle = np.linalg.qr(matrix * weight[:, None])
            solution = np.linalg.solve(triangle, span.T @ (value * weight))
            left = matrix @ solution - value
            weight = np.where(seen, 1 / np.hypot(1, left / _OUTLIER), 1.0)
        found.append(solution)
        missed.append(left * weight)
        spans.append((weight, span))
    return np.array(found), np.concatenate(missed), spans


def _slope(presses: list[Press], gamma: float) -> FloatArray:
    """(n, 3): of encoded values by linear ones in the pressed frames; 0 where clipped."""
    after = np.vstack([_linear(press.rest + press.changed, gamma) for press in presses])
    return np.asarray(after ** (1 / gamma - 1) / gamma * (after < 0.98))


def _moved(light: Light, sensor: Sensor, turn_deg: float, out: float, height_mm: float, size: float) -> Light:
    """The light turned around the gel's middle, at shares of its distance and size, at another height.

    It stays where this is in the camera's view, or outside gel and window.
    """
    x, y, _ = light.position_mm
    cosine, sine = out * np.cos(np.radians(turn_deg)), out * np.sin(np.radians(turn_deg))
    place = (float(cosine * x - sine * y), float(sine * x + cosine * y), height_mm)
    moved = light.model_copy(update={"position_mm": place, "size_mm": tuple(size * np.array(light.size_mm))})
    seen = room_of(sensor).intrusion(LightGeometry.of([moved])).any()
    return light if seen or height_mm >= sensor.gel.size_mm[2] + sensor.window.thickness_mm else moved


def _linear(levels: FloatArray, gamma: float) -> FloatArray:
    return np.asarray(np.clip(levels / 255, 2 / 255, 1) ** gamma)


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


def _leads(fit: SensorFit, variant: Variant) -> list[Light]:
    """For each channel, the light that gives the gel's middle most."""
    camera, lights = fit.sensor.camera, fit.sensor.lights
    gel = LitGel(fit.sensor, np.array([[camera.width / 2, camera.height / 2]]), variant)
    powers = np.array([np.multiply(light.power, light.color) for light in lights])
    return [lights[k] for k in (gel.contributions(LightGeometry.of(lights))[:, 0] * powers).argmax(axis=0)]


def _side(sensor: Sensor) -> FloatArray:
    """Sides (2,) in mm of the least rectangle around the origin that holds what the camera sees of the gel at rest."""
    camera = sensor.camera
    u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    seen = Optics.of(sensor).look(np.column_stack([u.ravel(), v.ravel()])).on_flat_face[:, :2]
    wide = np.minimum(2 * np.nanmax(np.abs(seen), axis=0), sensor.gel.size_mm[:2])
    texel = wide[0] / (camera.width // _COARSE)
    return np.array([wide[0], texel * round(wide[1] / texel)])


def _flat(sensor: Sensor, frames: Frames, fit: SensorFit, side: FloatArray) -> Image:
    """Radiance (rows, columns, 3) of the gel at rest on a rectangle of its face."""
    camera, columns = sensor.camera, sensor.camera.width // _COARSE
    rows = round(columns * side[1] / side[0])
    x, y = np.meshgrid((np.arange(columns) + 0.5) / columns - 0.5, (np.arange(rows) + 0.5) / rows - 0.5)
    at = np.column_stack([x.ravel() * side[0], y.ravel() * side[1], np.zeros(x.size)])
    pixels = (Optics.of(sensor).project(at) - 0.5).astype(np.float32).reshape(rows, columns, 2)
    linear = np.where(fit.bare[..., None], frames.encoded, smoothed(frames.encoded, fit.bare)) ** camera.gamma
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    linear /= camera.exposure * (1 - camera.vignetting * off_centre(camera, u, v))[:, :, None]
    found = cv2.remap(linear.astype(np.float32), pixels, None, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32)


def _basis(place: FloatArray, normal: FloatArray) -> FloatArray:
    """(n, 10 terms): forms of normals (n, 3), each times the terms in places (n, 2), as `LightModel` has them."""
    x, y = place.T
    n, m, o = normal.T
    terms = [x**power * y ** (degree - power) for degree in range(_DEGREE, -1, -1) for power in range(degree, -1, -1)]
    forms = np.stack([n * n, 2 * n * m, 2 * n * o, m * m, 2 * m * o, o * o, n, m, o, np.ones_like(n)])
    return np.asarray(np.einsum("fn,tn->nft", forms, np.stack(terms)).reshape(len(place), -1))
