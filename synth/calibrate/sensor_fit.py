"""A sensor fitted to frames of its undeformed gel: layout and camera first, then dots, lights and noise."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from synth.arrays import BoolArray, FloatArray, Pixels
from synth.calibrate.ball_fit import BallFit, Balls, find_presses, fit_balls
from synth.calibrate.dot_grid import DotGridFit, fit_dot_grid
from synth.calibrate.dots import FoundDots, find_dots
from synth.calibrate.frames import Frames
from synth.calibrate.irradiance import LightGeometry, LitGel
from synth.calibrate.lights import LightFit, Room, Target, fit_lights
from synth.calibrate.noise import fit_noise
from synth.calibrate.profile import DotProfile, blur_of, fit_profile
from synth.errors import InputError
from synth.optics import Optics
from synth.render.camera_image import off_centre
from synth.render.lights import check_view
from synth.render.pattern import pixels_per_mm
from synth.render.variant import Variant
from synth.scene import Camera, Dots, Light, Sensor

_PIXELS = 1200
"""Pixels that the lights are fitted to: the picture without dots is smooth."""
_REACH_MM = 4.0
"""How far a light may move from the preset's place, along each axis."""
_VIEW_MM = 0.3
"""Lights stay so far outside the camera's view."""
_PUSH_MM, _LONGEST_PUSH = 0.25, 40
"""Length of a step by which a light in the view is moved outward, and most such steps."""
_DOUBTED, _SMALLER, _BETTER, _CHECKING = 2 / 255, 0.6, 0.7, 6
"""Residual beyond which the ball's radius is doubted, share of it that is tried, share of the residual by which that
one is better, and steps of its fit."""
_DARKEST, _BRIGHTEST = 2 / 255, 253 / 255
"""Encoded values beyond these are clipped and tell nothing."""


@dataclass(frozen=True, eq=False)
class SensorFit:
    """The fitted sensor and how it was found.

    `dots` and `grid` are None for a bare coating; `bare` (H, W) are the pixels that show nothing but coating.
    """

    sensor: Sensor
    lights: LightFit
    dots: FoundDots | None
    grid: DotGridFit | None
    bare: BoolArray
    pressed: BallFit | None = None


def fit_sensor(
    start: Sensor, frames: Frames, variant: Variant, spacing_mm: float | None, steps: int, balls: Balls | None = None
) -> SensorFit:
    """Fit everything that undeformed frames tell, and the lights also to frames of a ball, if there are any.

    The preset's camera has the frames' size. Without the spacing of the dots' columns its field of view is kept. The
    lights' geometry takes at most `steps` steps. The variant is a vectorised one. InputError for no dots, or no grid,
    where the preset has some; for nothing that tells of the lights; and for overexposure.
    """
    gamma = start.camera.gamma
    linear = frames.encoded**gamma
    dots, grid, bare = find_grid(start, linear, spacing_mm)
    sensor = start
    if dots is not None and grid is not None:
        sensor = start.model_copy(update=_look(start, grid, fit_profile(dots)))
    pixels = _spread(bare & _sees_gel(sensor))
    if not len(pixels):
        raise InputError("no pixel between the dots sees the gel of the preset; check its sensor.gel and sensor.camera")
    at = (pixels[:, 1].astype(int), pixels[:, 0].astype(int))
    smooth = smoothed(frames.encoded, bare)[at]
    gel = LitGel(sensor, pixels, variant)
    target = _target(smooth, sensor.camera, pixels)
    shines = np.array([light.color for light in sensor.lights]) > 0
    room, vignetting = room_of(sensor), sensor.camera.vignetting
    fit = fit_lights(gel, target, LightGeometry.of(sensor.lights), shines, vignetting, room, steps)
    if steps > 0:
        clear = _clear_of_view(sensor, fit.geometry)
        again = fit_lights(gel, target, clear, shines, fit.vignetting, room, 0)
        fit = replace(again, steps=fit.steps)
    pressed = None
    if balls is not None:
        beside = {name: bare & find_bare(sensor, frame) for name, frame in balls.frames.items()}
        rest, first, moved = smoothed(frames.encoded, bare), fit, partial(_clear_of_view, sensor)

        def pressed_by(ball: Balls, most: int) -> BallFit:
            presses, series = find_presses(sensor, ball, rest, beside)
            return fit_balls(
                sensor, gel, target, first, shines, room, presses, series, ball.judged, variant, most, moved
            )

        pressed = pressed_by(balls, steps)
        _check_radius(pressed, balls, pressed_by)
        fit = pressed.lights
    read, shot = fit_noise(frames.single, bare, gamma, frames.step)
    noise: dict[str, Any] = {"read_noise": round(read, 6), "shot_noise": round(shot, 6)}
    camera = sensor.camera.model_copy(update={"vignetting": round(fit.vignetting, 4), **noise})
    lit = [i for i in range(len(sensor.lights)) if fit.powers[i].max() > 0]
    if not lit:
        raise InputError("no light of the preset explains any of the frames' brightness; are the frames black?")
    lights = tuple(_shining(_placed(sensor.lights[i], fit.geometry, i), fit.powers[i]) for i in lit)
    sensor = sensor.model_copy(update={"camera": camera, "lights": lights})
    return SensorFit(sensor, fit, dots, grid, bare, pressed)


def _check_radius(fit: BallFit, balls: Balls, fitted: Callable[[Balls, int], BallFit]) -> None:
    """InputError where a poor fit becomes far better with a smaller ball.

    The nearer the lights, the better they tell the radius: far ones light a flatter gel from lower alike (bas-relief
    ambiguity; Belhumeur, Kriegman and Yuille, IJCV 35, 1999).
    """
    if fit.lights.residual < _DOUBTED:
        return
    other, residual = replace(balls, radius_mm=_SMALLER * balls.radius_mm), np.inf
    with suppress(InputError):  # contacts are too wide for the smaller ball
        residual = fitted(other, _CHECKING).lights.residual
    if residual < _BETTER * fit.lights.residual:
        raise InputError(
            f"--radius-mm = {balls.radius_mm:g}: a ball of {other.radius_mm:.2g} mm explains the frames far better "
            f"({255 * residual:.1f} instead of {255 * fit.lights.residual:.1f} levels are left); check the radius"
        )


def find_grid(
    sensor: Sensor, linear: FloatArray, spacing_mm: float | None
) -> tuple[FoundDots | None, DotGridFit | None, BoolArray]:
    """Dots and grid of a linear frame (H, W, 3), None for a sensor without dots, and (H, W) its pixels beside dots."""
    if not isinstance(sensor.pattern, Dots):
        return None, None, np.ones(linear.shape[:2], dtype=bool)
    dots = find_dots(linear, sensor.pattern.spacing_mm[0] * pixels_per_mm(sensor))
    return dots, fit_dot_grid(sensor, sensor.pattern, dots.centres, spacing_mm), ~dots.covered


def find_bare(sensor: Sensor, encoded: FloatArray) -> BoolArray:
    """(H, W): a frame's pixels beside dots, wherever these are."""
    if not isinstance(sensor.pattern, Dots):
        return np.ones(encoded.shape[:2], dtype=bool)
    return ~find_dots(encoded**sensor.camera.gamma, sensor.pattern.spacing_mm[0] * pixels_per_mm(sensor)).covered


def _look(start: Sensor, grid: DotGridFit, profile: DotProfile) -> dict[str, Any]:
    """Pattern and camera with what the dots told."""
    scale = pixels_per_mm(start.model_copy(update={"camera": grid.camera}))
    softness = grid.pattern.softness_mm
    coating = np.array(start.coating.reflectance)
    pattern = grid.pattern.model_copy(
        update={
            "radius_mm": round(profile.radius_px / scale, 4),
            "radius_jitter": round(min(profile.radius_jitter, 1.0), 4),
            "reflectance": tuple(float(value) for value in np.round(profile.ratio * coating, 4)),
        }
    )
    blur = {"blur_px": round(blur_of(profile, softness * scale), 3)}
    return {"pattern": pattern, "camera": grid.camera.model_copy(update=blur)}


def _target(encoded: FloatArray, camera: Camera, pixels: Pixels) -> Target:
    """Signals at pixels; clipped values get no weight."""
    level = np.clip(encoded, _DARKEST, 1)
    slope = level ** (1 - camera.gamma) / camera.gamma
    slope[(encoded > _BRIGHTEST) | (encoded < _DARKEST)] = 0
    for name, channel in zip(("red", "green", "blue"), encoded.T, strict=True):
        if (channel > _BRIGHTEST).all():
            raise InputError(
                f"the frames are overexposed: all of the coating is at the top of the range in {name}; take darker ones"
            )
    return Target(encoded**camera.gamma, slope, camera.exposure, off_centre(camera, *pixels.T))


def smoothed(encoded: FloatArray, bare: BoolArray) -> FloatArray:
    """Means (H, W, 3) over bare pixels near by, which takes noise away and leaves shading."""
    weight = cv2.GaussianBlur(bare.astype(np.float64), (0, 0), 1.5)
    blurred = cv2.GaussianBlur(encoded * bare[:, :, None], (0, 0), 1.5)
    return np.asarray(blurred / np.maximum(weight, 1e-9)[:, :, None], dtype=np.float64)


def _spread(usable: BoolArray) -> Pixels:
    """Centres (n, 2) of some _PIXELS usable pixels, on a regular grid."""
    step = max(1, int(np.sqrt(usable.size / _PIXELS)))
    rows, columns = np.nonzero(usable[step // 2 :: step, step // 2 :: step])
    return np.asarray(np.column_stack([columns, rows]) * float(step) + step // 2 + 0.5, dtype=np.float64)


def _sees_gel(sensor: Sensor) -> BoolArray:
    """(H, W): whether a pixel sees the undeformed contact face."""
    camera = sensor.camera
    optics = Optics.of(sensor)
    with np.errstate(invalid="ignore"):
        hit = optics.look(optics.centres).on_flat_face[:, :2]
        inside = np.all(np.abs(hit) < np.array(sensor.gel.size_mm[:2]) / 2, axis=1)
    return np.asarray(inside.reshape(camera.height, camera.width))


def room_of(sensor: Sensor, reach_mm: float = _REACH_MM) -> Room:
    """Each light stays near its place, in the body, and outside what the camera sees."""
    camera = sensor.camera
    u, v = np.meshgrid(np.linspace(0, camera.width, 5), np.linspace(0, camera.height, 5))
    rays = Optics.of(sensor).look(np.column_stack([u.ravel(), v.ravel()]))
    top = sensor.gel.size_mm[2] + sensor.window.thickness_mm
    levels = []
    for z in (0.0, top):
        seen = (rays.on_flat_face + rays.directions * (z / rays.directions[:, 2:]))[:, :2]
        levels.append(np.stack([np.nanmin(seen, axis=0) - _VIEW_MM, np.nanmax(seen, axis=0) + _VIEW_MM]))
    centre = np.array([light.position_mm for light in sensor.lights])
    low, high = centre - reach_mm, centre + reach_mm
    low[:, 2], high[:, 2] = np.maximum(low[:, 2], 0.4), np.minimum(high[:, 2], top - 0.4)
    return Room(low, high, levels[0], (levels[1] - levels[0]) / top)


def _clear_of_view(sensor: Sensor, geometry: LightGeometry) -> LightGeometry:
    """The same lights, those that turned into the camera's view moved outward until they are out of it."""
    centre = geometry.centre.copy()
    for i, light in enumerate(sensor.lights):
        outward = centre[i, :2] / max(float(np.linalg.norm(centre[i, :2])), 1e-9)
        for _ in range(_LONGEST_PUSH):
            moved = _placed(light, replace(geometry, centre=centre), i)
            try:
                check_view(sensor.model_copy(update={"lights": (moved,)}))
                break
            except InputError:
                centre[i, :2] += _PUSH_MM * outward
    return replace(geometry, centre=centre)


def _placed(light: Light, geometry: LightGeometry, i: int) -> Light:
    """The light with the i-th place, direction, size and angle; its aim stays as far away as it was."""
    direction = geometry.direction[i] / np.linalg.norm(geometry.direction[i])
    distance = float(np.linalg.norm(np.subtract(light.aim_mm, light.position_mm)))
    fields = {
        "position_mm": geometry.centre[i],
        "aim_mm": geometry.centre[i] + distance * direction,
        "size_mm": geometry.size[i],
    }
    placed = {key: tuple(np.round(value, 4).tolist()) for key, value in fields.items()}
    return light.model_copy(update=placed | {"viewing_angle_deg": round(float(geometry.viewing_angle_deg[i, 0]), 2)})


def _shining(light: Light, power: FloatArray) -> Light:
    """The light with the powers (3,) of its channels: its brightest channel has colour 1."""
    color = tuple(np.round(power / power.max(), 4).tolist())
    return light.model_copy(update={"color": color, "power": float(f"{power.max():.6g}")})
