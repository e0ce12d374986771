"""Lights fitted to presses of a ball, together with the gel at rest: from several layouts, with place and depth."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from synth.arrays import BoolArray, FloatArray, Pixels
from synth.calibrate.contact import Contact, change, find_contact, flanks
from synth.calibrate.irradiance import LightGeometry, LitGel, PressChange
from synth.calibrate.layouts import chosen
from synth.calibrate.lights import LightFit, Room, Target, fit_lights
from synth.calibrate.pressed_ball import PressedBall, press_ball
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
_SIMULATIONS, _TOLERANCE = 22, 0.05
"""Presses simulated to find one's place and depth, and how near (mm, and share of the depth) is enough."""
_DEEPER, _SHORT = 0.1, 4
"""Change of the depths' logarithm, and steps of the lights' fit, by which the depth of all presses is found. Lower
lights colour flatter flanks alike, so that fitting one beside the other hardly moves either."""
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

    def ball(self, sensor: Sensor, balls: Balls) -> PressedBall:
        """The gel's face under the ball at its place and depth."""
        return press_ball(sensor, balls.radius_mm, float(np.exp(self.pose[2])), self.pose[:2], balls.friction)

    def azimuth_and_rise(self, changed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Those of `synth.calibrate.contact.flanks`, of a change (n, 3) at the pixels."""
        return flanks(self.pixels, changed, replace(self.contact, radius=_EDGE * self.contact.radius))


@dataclass(frozen=True, eq=False)
class BallFit:
    """Lights that explain rest and presses; the presses, and of each the change as fitted, levels (n, 3)."""

    lights: LightFit
    presses: tuple[Press, ...]
    fitted: tuple[FloatArray, ...]


def find_presses(sensor: Sensor, balls: Balls, rest: FloatArray, bare: dict[str, BoolArray]) -> tuple[Press, ...]:
    """Contacts in all frames; InputError for one without, of another gel, or that the ball cannot make.

    `rest` (H, W, 3) is the gel at rest, encoded; `bare` (H, W) are each frame's pixels beside dots.
    """
    return tuple(_found(sensor, balls, name, rest, bare[name]) for name in balls.frames)


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
    depth = 0.7 * radius_mm**2 / balls.radius_mm
    for _ in range(2):
        ball = press_ball(sensor, balls.radius_mm, depth, place, balls.friction)
        depth *= np.clip((radius_mm / max(ball.contact_mm, 1e-3)) ** 2, 0.4, 2.5)
    pixels = np.column_stack([columns, rows]).astype(np.float64) + 0.5
    at_rest = 255 * rest[rows, columns]
    return Press(name, contact, pixels, at_rest, changed[rows, columns], np.array([*place, np.log(depth)]))


def fit_balls(
    sensor: Sensor, gel: LitGel, target: Target, first: LightFit, shines: BoolArray, room: Room,
    presses: Sequence[Press], balls: Balls, variant: Variant, steps: int,
) -> BallFit:  # fmt: skip
    """Fit lights to the gel at rest, with its target, and to presses that are not only judged.

    They start from the fit to the gel at rest and from lights chosen all around; the better one is followed, with
    the balls' places and depths found between two fits. Those of the presses that are judged are found last.
    """
    flats = {press.name: LitGel(sensor, press.pixels, variant) for press in presses}

    def change_of(press: Press) -> PressChange:
        ball = press.ball(sensor, balls)
        return PressChange(LitGel(sensor, press.pixels, variant, (ball.surface, ball.positions)), flats[press.name])

    def fitted(start: LightGeometry, vignetting: float, most: int, limits: Room) -> LightFit:
        return fit_lights((gel, *changes), whole, start, shines, vignetting, limits, most)

    def deeper(presses: list[Press], by: float) -> list[Press]:
        return [replace(press, pose=press.pose + np.array([0.0, 0.0, by])) for press in presses]

    def placed(press: Press, fit: LightFit) -> Press:
        part = _with_changes(None, sensor, [press])
        gain = (sensor.camera.exposure * (1 - fit.vignetting * part.corner))[:, None]

        def misfit(pose: FloatArray) -> float:
            try:
                basis = change_of(replace(press, pose=pose)).contributions(fit.geometry)
            except InputError:
                return np.inf
            miss = part.slope * (np.einsum("mpc,mc->pc", basis, fit.powers) * gain - part.signal)
            return float(np.sum(miss**2))

        simplex = press.pose + np.vstack([np.zeros(3), np.diag([0.2, 0.2, -0.25])])
        options = {"maxfev": _SIMULATIONS, "initial_simplex": simplex, "xatol": _TOLERANCE, "fatol": 1e-9}
        return replace(press, pose=minimize(misfit, press.pose, method="Nelder-Mead", options=options).x)

    told = [press for press in presses if press.name not in balls.judged]
    whole, changes = _with_changes(target, sensor, told), [change_of(press) for press in told]
    like = first.geometry
    everywhere = chosen((gel, *changes), whole, like, shines, first.vignetting, room)
    reach = (room.high - room.low) / 2
    low = np.maximum(everywhere.centre - reach, [-np.inf, -np.inf, room.low[:, 2].min()])
    high = np.minimum(everywhere.centre + reach, [np.inf, np.inf, room.high[:, 2].max()])
    rooms = room, replace(room, low=low, high=high)
    fits = [fitted(start, first.vignetting, max(steps // 2, 1), limits)
            for start, limits in zip((like, everywhere), rooms, strict=True)]  # fmt: skip
    best = int(np.argmin([fit.residual for fit in fits]))
    fit, told = fits[best], [placed(press, fits[best]) for press in told]
    missed = np.full(3, np.inf)
    for number, by in enumerate((-_DEEPER, 0.0, _DEEPER)):
        with suppress(InputError):  # too deep for the gel
            changes = [change_of(press) for press in deeper(told, by)]
            missed[number] = fitted(fit.geometry, fit.vignetting, min(steps, _SHORT), rooms[best]).residual ** 2
    at = float(np.argmin(missed) - 1)
    if np.isfinite(missed).all() and missed[1] == missed.min():
        at = 0.5 * (missed[0] - missed[2]) / (missed[0] - 2 * missed[1] + missed[2])  # the parabola's least
    told = deeper(told, _DEEPER * at)
    changes = [change_of(press) for press in told]
    fit = fitted(fit.geometry, fit.vignetting, steps, rooms[best])
    judged = [placed(press, fit) for press in presses if press.name in balls.judged]
    models = []
    for press in (*told, *judged):
        gain = target.gain * (1 - fit.vignetting * off_centre(sensor.camera, *press.pixels.T))
        pressed = change_of(press)
        before, more = (np.einsum("mpc,mc->pc", one.contributions(fit.geometry), fit.powers) * gain[:, None]
                        for one in (pressed.rest, pressed))  # fmt: skip
        level = np.maximum(before, 0) ** (1 / sensor.camera.gamma)
        models.append(255 * (np.maximum(before + more, 0) ** (1 / sensor.camera.gamma) - level))
    return BallFit(fit, (*told, *judged), tuple(models))


def _with_changes(target: Target | None, sensor: Sensor, presses: Sequence[Press]) -> Target:
    """The target at rest, if any, and what presses change after it."""
    gamma, parts = sensor.camera.gamma, [] if target is None else [target]
    signals, slopes, corners = ([getattr(part, name) for part in parts] for name in ("signal", "slope", "corner"))
    for press in presses:
        before, after = (np.clip(level / 255, 2 / 255, 1) for level in (press.rest, press.rest + press.changed))
        slope = _WEIGHT * ((before + after) / 2) ** (1 - gamma) / gamma
        slope[(after > 253 / 255) | (before > 253 / 255)] = 0
        signals.append(after**gamma - before**gamma)
        slopes.append(slope)
        corners.append(off_centre(sensor.camera, *press.pixels.T))
    return Target(np.vstack(signals), np.vstack(slopes), sensor.camera.exposure, np.concatenate(corners))
