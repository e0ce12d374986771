"""Lights fitted to presses of a ball, together with the gel at rest: from several layouts, with place and depth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import minimize

from synth.arrays import BoolArray, FloatArray, Pixels
from synth.calibrate.contact import Contact, change, find_contact, flanks
from synth.calibrate.irradiance import LightGeometry, LitGel, PressChange
from synth.calibrate.layouts import chosen
from synth.calibrate.lights import LightFit, PressAt, Room, Target, fit_lights
from synth.calibrate.pressed_ball import BallSeries, press_series
from synth.errors import InputError
from synth.optics import Optics
from synth.render.camera_image import off_centre
from synth.render.pattern import pixels_per_mm
from synth.render.variant import Variant
from synth.scene import Sensor

_WEIGHT = 1.5
"""Weight of what presses change against the gel at rest."""
_AROUND, _ACROSS = 1.7, 16
"""Pixels that count around a contact, over its radius, and how many across."""
_MOVED_LEVELS = 10.0
"""Levels of 255 by which half of a frame may differ from the gel at rest beside the contact; auto-exposure takes 6."""
_TRIALS, _TOLERANCE = 60, 0.01
"""Poses that are tried to find one press's, and how near (mm, and share of the depth) is enough."""
_SHORT = 6
"""Steps of the fits from each start, of which the best is followed."""
_DEEPEST = 1.5
"""Depth to which presses are simulated, over that of a sphere's cap as wide as the widest contact."""
_SHARP_PX = 0.7
"""Smoothing of the changes that lights are fitted to, which the model has not: more of it would flatten flanks."""
_EDGE = 0.9
"""Share of the circle's radius within which flanks are measured."""


@dataclass(frozen=True, eq=False)
class Balls:
    """Frames (H, W, 3) of the gel under one ball, encoded, by name, and the friction that is taken for all.

    Lights are not fitted to frames that are `judged`.
    """

    frames: dict[str, FloatArray]
    radius_mm: float
    friction: float
    judged: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Press:
    """One frame's contact, and what the press changes at pixels (n, 2): levels of 255 (n, 3), beside the level at rest.

    `pose` (3,) is the ball's place, mm, and the logarithm of its depth in mm.
    """

    name: str
    contact: Contact
    pixels: Pixels
    rest: FloatArray
    changed: FloatArray
    pose: FloatArray

    def azimuth_and_rise(self, changed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Those of `synth.calibrate.contact.flanks`, of a change (n, 3) at the pixels."""
        return flanks(self.pixels, changed, replace(self.contact, radius=_EDGE * self.contact.radius))


@dataclass(frozen=True, eq=False)
class BallFit:
    """Lights that explain rest and presses; the presses, and of each the change as fitted, levels (n, 3)."""

    lights: LightFit
    presses: tuple[Press, ...]
    fitted: tuple[FloatArray, ...]
    series: BallSeries


def find_presses(
    sensor: Sensor, balls: Balls, rest: FloatArray, bare: dict[str, BoolArray]
) -> tuple[tuple[Press, ...], BallSeries]:
    """Contacts in all frames, and the ball's faces; InputError for one without, of another gel, or of another ball.

    `rest` (H, W, 3) is the gel at rest, encoded; `bare` (H, W) are each frame's pixels beside dots.
    """
    presses = [_found(sensor, balls, name, rest, bare[name]) for name in balls.frames]
    wide = np.array([press.contact.radius for press in presses]) / pixels_per_mm(sensor)
    series = press_series(sensor, balls.radius_mm, _DEEPEST * float(wide.max()) ** 2 / balls.radius_mm, balls.friction)
    depths = np.log([series.depth_mm(radius) for radius in wide])
    return tuple(replace(press, pose=np.array([*press.pose[:2], depth]))
                 for press, depth in zip(presses, depths, strict=True)), series  # fmt: skip


def _found(sensor: Sensor, balls: Balls, name: str, rest: FloatArray, bare: BoolArray) -> Press:
    changed = change(balls.frames[name], rest, bare)
    contact = find_contact(changed, name)
    away = contact.away(rest.shape)
    beside = np.median(np.abs(changed[(away > 2) & bare]), axis=0) if ((away > 2) & bare).any() else np.zeros(3)
    if beside.max() > _MOVED_LEVELS:
        raise InputError(
            f"{name}: beside the ball it differs by {beside.max():.1f} of 255 from the frames at rest; the camera "
            "moved, or it is another sensor's"
        )
    step = max(1, round(2 * _AROUND * contact.radius / _ACROSS))
    grid = np.zeros_like(bare)
    grid[::step, ::step] = True
    rows, columns = np.nonzero((away < _AROUND) & bare & grid)
    radius_mm = contact.radius / pixels_per_mm(sensor)
    if radius_mm > 0.95 * balls.radius_mm:
        raise InputError(
            f"{name}: its contact has a radius of {radius_mm:.2g} mm, which no ball of "
            f"--radius-mm = {balls.radius_mm:g} makes; check the radius"
        )
    place = Optics.of(sensor).look(np.array([contact.middle])).on_flat_face[0, :2]
    pixels = np.column_stack([columns, rows]).astype(np.float64) + 0.5
    at_rest, changed = 255 * rest[rows, columns], change(balls.frames[name], rest, bare, _SHARP_PX)
    return Press(name, contact, pixels, at_rest, changed[rows, columns], np.array([*place, 0.0]))


def fit_balls(
    sensor: Sensor, gel: LitGel, target: Target, first: LightFit, shines: BoolArray, room: Room,
    presses: Sequence[Press], series: BallSeries, judged: frozenset[str], variant: Variant, steps: int,
    clear: Callable[[LightGeometry], LightGeometry],
) -> BallFit:  # fmt: skip
    """Fit lights to the gel at rest, with its target, and to presses that are not only judged, with their poses.

    They start from the fit to the gel at rest and from lights chosen all around; the best one is followed. `clear`
    moves lights out of the view. The poses of presses that are judged are found last.
    """

    def change_at(press: Press) -> PressAt:
        flat = LitGel(sensor, press.pixels, variant)
        lit = partial(LitGel, sensor, press.pixels, variant)
        return lambda pose: PressChange(lit((series.surface, series.face(pose))), flat)

    def fitted(start: LightGeometry, most: int, limits: Room, poses: FloatArray, vignetting: float) -> LightFit:
        return fit_lights(gel, whole, start, shines, vignetting, limits, most, at, poses)

    told = [press for press in presses if press.name not in judged]
    whole, at = _with_changes(target, sensor, told), [change_at(press) for press in told]
    poses = np.array([press.pose for press in told])
    best, reach = (
        (fitted(first.geometry, min(steps, _SHORT), room, poses, first.vignetting), room),
        room.high - room.low,
    )
    for known in (False, True):  # lights from all around; then the best ones, of which some may stand elsewhere
        start = best[0] if known else first
        at_poses = best[0].poses if known else poses
        gels: list[LitGel | PressChange] = [gel, *(one(pose) for one, pose in zip(at, at_poses, strict=True))]
        layout = chosen(gels, whole, start.geometry, shines, start.vignetting, room, fitted=known)
        low = np.maximum(layout.centre - reach / 2, [-np.inf, -np.inf, room.low[:, 2].min()])
        high = np.minimum(layout.centre + reach / 2, [np.inf, np.inf, room.high[:, 2].max()])
        limits = replace(room, low=low, high=high)
        other = fitted(layout, min(steps, _SHORT), limits, at_poses, start.vignetting)
        best = min(best, (other, limits), key=lambda each: each[0].residual)
    fit = fitted(best[0].geometry, steps, best[1], best[0].poses, best[0].vignetting)
    again = fitted(clear(fit.geometry), 0, best[1], fit.poses, fit.vignetting)
    fit = replace(again, steps=fit.steps)

    def model(one: PressAt, press: Press) -> FloatArray:
        """What a press changes under the lights as fitted, levels (n, 3)."""
        gain = target.gain * (1 - fit.vignetting * off_centre(sensor.camera, *press.pixels.T))
        pressed = one(press.pose)
        before, more = (np.einsum("mpc,mc->pc", part.contributions(fit.geometry), fit.powers) * gain[:, None]
                        for part in (pressed.rest, pressed))  # fmt: skip
        level = np.maximum(before, 0) ** (1 / sensor.camera.gamma)
        return np.asarray(255 * (np.maximum(before + more, 0) ** (1 / sensor.camera.gamma) - level))

    shown = [(replace(press, pose=pose), one) for press, pose, one in zip(told, fit.poses, at, strict=True)]
    for press in presses:
        if press.name in judged:
            one = change_at(press)
            shown.append((placed(press, partial(model, one)), one))
    return BallFit(fit, tuple(press for press, _ in shown), tuple(model(one, press) for press, one in shown), series)


def placed(press: Press, model: Callable[[Press], FloatArray]) -> Press:
    """The press at the pose whose change by a model, levels (n, 3), is nearest to the frame's."""

    def misfit(pose: FloatArray) -> float:
        return float(np.sum((model(replace(press, pose=pose)) - press.changed) ** 2))

    simplex = press.pose + np.vstack([np.zeros(3), np.diag([0.2, 0.2, -0.25])])
    options = {"maxfev": _TRIALS, "initial_simplex": simplex, "xatol": _TOLERANCE, "fatol": 1e-9}
    return replace(press, pose=minimize(misfit, press.pose, method="Nelder-Mead", options=options).x)


def _with_changes(target: Target, sensor: Sensor, presses: Sequence[Press]) -> Target:
    """The target at rest, and what presses change after it."""
    gamma = sensor.camera.gamma
    signals, slopes, corners = [target.signal], [target.slope], [target.corner]
    for press in presses:
        before, after = (np.clip(level / 255, 2 / 255, 1) for level in (press.rest, press.rest + press.changed))
        slope = _WEIGHT * ((before + after) / 2) ** (1 - gamma) / gamma
        slope[(after > 253 / 255) | (before > 253 / 255)] = 0
        signals.append(after**gamma - before**gamma)
        slopes.append(slope)
        corners.append(off_centre(sensor.camera, *press.pixels.T))
    return Target(np.vstack(signals), np.vstack(slopes), sensor.camera.exposure, np.concatenate(corners))
