r"""Lights fitted to a picture of the undeformed gel: powers in closed form, geometry by steps around that.

The undeformed picture is linear in the lights' powers: with the signal of pixel p in channel c

.. math::  s_{pc} = e \, v_p \sum_i P_{ic} E_{ipc}(\theta)

(exposure e, vignette v, contributions E of `synth.calibrate.irradiance`) the best non-negative powers for a given
geometry θ are a small least-squares problem per channel with one exact answer (Lawson and Hanson, 1974). What is left,

.. math::  J(\theta) = \min_{P \ge 0} \frac{M}{2 σ^2 n} \sum_{pc} w_{pc}^2 (s_{pc} - \hat s_{pc})^2
                       + \frac12 |\theta|^2,

depends on θ alone (variable projection, Golub and Pereyra 1973). Levenberg-Marquardt steps descend it, with the
derivatives of E from Dr.Jit and Kaufman's Jacobian (BIT 15, 1975): what a change of θ does to the picture, less what
other powers would make of it. w is the slope of the camera's response, so that residuals are in encoded values, as they
are seen. θ are displacements from where the fit starts, in units of how far a light may plausibly be from there: what
the picture does not tell stays where it was.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from scipy.optimize import nnls

from synth.arrays import BoolArray, FloatArray
from synth.calibrate.irradiance import LightGeometry, LitGel, PressChange

CENTRE_MM, DIRECTION, LOG_SIZE, LOG_ANGLE, VIGNETTING = 2.0, 0.4, 0.5, 0.4, 0.3
"""Standard deviations of the prior: of a light's place, of its unit direction, of the logarithms of its sizes and of
its viewing angle, and of the vignetting."""
_SCALE = np.repeat([CENTRE_MM, DIRECTION, LOG_SIZE, LOG_ANGLE], [3, 3, 2, 1])
_POSE, _POSE_STEP = np.array([0.3, 0.3, 0.4]), 0.05
"""Standard deviations of a press's pose, and the step of its derivatives in these."""
_WIDE = 0.5
"""Factor of a Lambertian light's directions: what it lights hardly tells them, and its power depends on them."""
_SIZES = 1.5
"""Largest displacement of a size, in standard deviations: a factor of 2.1 either way."""
_NARROWEST_DEG, WIDEST_DEG = 10.0, 120.0
RESIDUAL = 1 / 255
"""Standard deviation of the misfit that the model may leave, in encoded values."""
INDEPENDENT = 300.0
"""Number of independent values that a smooth picture counts for, and so does what each press changes."""

_SEEN_MM, _STEP = 0.05, 1e-4
"""Standard deviation of a light's intrusion into the view, without presses, and the step of its derivatives in such."""

_DAMPINGS, _LEAST_GAIN = (0.0, 1.0, 10.0, 100.0, 1e3, 1e4, 1e5), 3e-4
"""What is added to the curvature, in that of the prior; least share that a step must take off the misfit."""
_GOOD_GAIN = 0.02
"""Share that is enough for no further damping to be tried."""


@dataclass(frozen=True, eq=False)
class Target:
    """What the lights are to explain, at n pixels, with the camera's exposure as gain.

    Signals (n, 3) are linear, full scale 1, with the slope (n, 3) of the encoded value by the linear one; `corner` (n,)
    is the squared distance from the principal point over that of the farthest corner.
    """

    signal: FloatArray
    slope: FloatArray
    gain: float
    corner: FloatArray


Gels: TypeAlias = Sequence[LitGel | PressChange]
"""The gel at rest, and what presses change."""
PressAt: TypeAlias = Callable[[FloatArray], PressChange]
"""What a press changes, by its pose (3,): place in mm, and the logarithm of its depth in mm."""


@dataclass(frozen=True, eq=False)
class Room:
    """Where lights may be: centres from `low` to `high`, (m, 3) mm each, and no part within the camera's view.

    At the height z the view reaches from `view[0] + z slope[0]` to `view[1] + z slope[1]`, each (2,) mm along x and y.
    """

    low: FloatArray
    high: FloatArray
    view: FloatArray
    slope: FloatArray

    def intrusion(self, lights: LightGeometry) -> FloatArray:
        """(m, 99) mm by which points of the lights, 33 along by 3 across, are within the view: 0 outside."""
        facing = lights.direction / np.linalg.norm(lights.direction, axis=1, keepdims=True)
        first = np.cross([0.0, 0.0, 1.0], facing)
        first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-6)
        along, across = first * lights.size[:, :1], np.cross(facing, first) * lights.size[:, 1:]
        u, v = (axis.ravel()[:, None] for axis in np.meshgrid(np.linspace(-0.5, 0.5, 33), np.linspace(-0.5, 0.5, 3)))
        points = lights.centre[:, None] + u * along[:, None] + v * across[:, None]
        low, high = self.view[:, None, None] + self.slope[:, None, None] * points[..., 2:]
        inside = np.minimum(points[..., :2] - low, high - points[..., :2]).min(axis=2)
        return np.asarray(np.maximum(inside, 0.0))


@dataclass(frozen=True, eq=False)
class LightFit:
    """The lights' geometry and powers (m, 3) per channel, the camera's vignetting, and presses' poses, found in steps.

    The residual is the root mean square, encoded, full scale 1.
    """

    geometry: LightGeometry
    powers: FloatArray
    vignetting: float
    residual: float
    steps: int
    poses: FloatArray


def fit_lights(
    gel: LitGel, target: Target, start: LightGeometry, shines: BoolArray, vignetting: float, room: Room, steps: int,
    presses: Sequence[PressAt] = (), poses: FloatArray | None = None,
) -> LightFit:  # fmt: skip
    """Fit powers, geometry and vignetting to a target at the pixels of the gel at rest, and of presses after it.

    The presses' poses (k, 3) are fitted with the lights: lower lights colour flatter flanks alike.
    The geometry starts from `start`, the distance from which is what the prior penalises, and stays in the room.
    `shines` (m, 3) are the channels in which each light may have power. At most `steps` steps are taken; 0 fits the
    powers alone.
    """
    poses = np.zeros((0, 3)) if poses is None else poses
    problem = _Problem(gel, target, start, shines, vignetting, room, presses, poses)
    if steps == 0:
        return problem.result(np.zeros(problem.size), 0)
    theta, taken = _descend(problem, steps)
    return problem.result(theta, taken)


def _descend(problem: "_Problem", most: int) -> tuple[FloatArray, int]:
    """Levenberg-Marquardt steps within the box, and their number.

    A light that comes into the way of another's makes the misfit jump. A trust region would shrink there to nothing: of
    each step dampings around that of the step before are tried, and all of them before giving up.
    """
    low, high = problem.box()
    theta, before = np.clip(np.zeros(problem.size), low, high), 2
    cost = np.sum(problem.residual(theta) ** 2)
    for number in range(most):
        jacobian = problem.jacobian(theta)
        slope = jacobian.T @ problem.residual(theta)
        free = ((theta > low) | (slope < 0)) & ((theta < high) | (slope > 0))
        curvature = (jacobian.T @ jacobian)[np.ix_(free, free)]
        best, chosen = (theta, cost), before
        order = sorted(range(len(_DAMPINGS)), key=lambda k: abs(k - before))
        for tried, k in enumerate(order):
            moved = theta.copy()
            moved[free] -= np.linalg.solve(curvature + _DAMPINGS[k] * np.eye(free.sum()), slope[free])
            moved = np.clip(moved, low, high)
            missed = np.sum(problem.residual(moved) ** 2)
            if missed < best[1]:
                best, chosen = (moved, missed), k
            if tried >= 2 and best[1] < (1 - _GOOD_GAIN) * cost:
                break
        done = best[1] > (1 - _LEAST_GAIN) * cost
        (theta, cost), before = best, chosen
        if done:
            return theta, number + 1
    return theta, most


class _Problem:
    """J of the module's docstring."""

    def __init__(
        self, gel: LitGel, target: Target, start: LightGeometry, shines: BoolArray, vignetting: float, room: Room,
        presses: Sequence[PressAt], poses: FloatArray,
    ) -> None:  # fmt: skip
        unit = start.direction / np.linalg.norm(start.direction, axis=1, keepdims=True)
        self._start = replace(start, direction=unit)
        self._gel, self._target, self._shines, self._vignetting, self._room = gel, target, shines, vignetting, room
        self._presses, self._poses = presses, poses
        self._made: dict[tuple[int, bytes], PressChange] = {}
        self._cached: tuple[FloatArray, tuple[FloatArray, FloatArray, LightGeometry]] | None = None
        self._lights = len(start.centre)
        self._scale = _SCALE * np.ones((self._lights, 1))
        wide = start.viewing_angle_deg[:, 0] == WIDEST_DEG  # stay so
        self._scale[wide, 3:6] *= _WIDE
        self._scale[wide, 8] = 0
        self._own = 9 * self._lights + 1
        self.size = self._own + poses.size
        self._factor = float(np.sqrt(INDEPENDENT * (1 + len(presses)) / target.signal.size)) / RESIDUAL
        self._seen_mm = _SEEN_MM / float(np.sqrt(1 + len(presses)))

    def geometry(self, theta: FloatArray) -> LightGeometry:
        start, moved = self._start, theta[: self._own - 1].reshape(-1, 9) * self._scale
        centre, direction, size, angle = np.split(moved, [3, 6, 8], axis=1)
        angles = start.viewing_angle_deg * np.exp(angle)
        return LightGeometry(start.centre + centre, start.direction + direction, start.size * np.exp(size), angles)

    def poses(self, theta: FloatArray) -> FloatArray:
        """(k, 3)."""
        return np.asarray(self._poses + theta[self._own :].reshape(-1, 3) * _POSE)

    def _gels(self, theta: FloatArray) -> list[LitGel | PressChange]:
        poses = self.poses(theta)
        made = {}
        for k, press in enumerate(self._presses):
            key = k, poses[k].tobytes()
            made[key] = self._made.get(key) or press(poses[k])
        self._made = made
        return [self._gel, *made.values()]

    def box(self) -> tuple[FloatArray, FloatArray]:
        low, high = np.full((self._lights, 9), -4.0), np.full((self._lights, 9), 4.0)
        low[:, 6:8], high[:, 6:8] = -_SIZES, _SIZES
        low[:, 8], high[:, 8] = 0, 0
        for box, centre, angle in ((low, self._room.low, _NARROWEST_DEG), (high, self._room.high, WIDEST_DEG)):
            box[:, :3] = (centre - self._start.centre) / CENTRE_MM
            box[:, 8:] += np.log(angle / self._start.viewing_angle_deg) / LOG_ANGLE
        dark = (np.array([0, 0.9]) - self._vignetting) / VIGNETTING
        far = np.full(self._poses.size, 4.0)
        return np.r_[low.ravel(), dark[0], -far], np.r_[high.ravel(), dark[1], far]

    def residual(self, theta: FloatArray) -> FloatArray:
        """(3 n + len(theta) + 99 m,): weighted misfit by channel, the prior, and how far lights are in the view."""
        basis, powers, geometry = self._solved(theta)
        miss = np.einsum("mpc,mc->pc", basis, powers) - self._target.signal
        seen = self._room.intrusion(geometry).ravel() / self._seen_mm
        return np.concatenate([(self._factor * self._target.slope * miss).T.ravel(), theta, seen])

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Kaufman's, of `residual`."""
        basis, powers, geometry = self._solved(theta)
        weight = self._factor * self._target.slope
        vignette = self._vignette(theta)[None, None, :, None]
        gels = self._gels(theta)
        change = np.concatenate([gel.derivatives(geometry) for gel in gels], axis=2) * (self._target.gain * vignette)
        logarithmic = np.c_[np.ones((self._lights, 6)), geometry.size, geometry.viewing_angle_deg]
        change *= (self._scale * logarithmic)[:, :, None, None]
        radiance = np.einsum("mpc,mc->pc", basis, powers) / self._vignette(theta)[:, None]
        corner = -VIGNETTING * self._target.corner[:, None] * radiance
        posed = self._posed(theta, gels, powers, geometry)
        blocks = []
        for channel in range(3):
            moved = change[..., channel] * powers[:, None, None, channel]
            parts = moved.reshape(self._own - 1, -1).T, corner[:, channel], posed[..., channel].T
            columns = np.column_stack(parts) * weight[:, channel, None]
            lit = powers[:, channel] > 0
            if lit.any():
                span = np.linalg.qr((basis[lit, :, channel] * weight[:, channel]).T)[0]
                columns = columns - span @ (span.T @ columns)
            blocks.append(columns)
        return np.vstack([*blocks, np.eye(self.size), self._seen(theta)])

    def _posed(
        self, theta: FloatArray, gels: Sequence[LitGel | PressChange], powers: FloatArray, geometry: LightGeometry
    ) -> FloatArray:
        """(3 k, n, 3): derivatives of the signals by the presses' poses."""
        found = np.zeros((self._poses.size, *self._target.signal.shape))
        gain = self._target.gain * self._vignette(theta)[:, None]
        last = len(self._target.signal)
        for k in reversed(range(len(self._presses))):
            before = gels[k + 1].contributions(geometry)
            at = slice(last - before.shape[1], last)
            for axis in range(3):
                pose = self.poses(theta)[k] + _POSE_STEP * _POSE * np.eye(3)[axis]
                more = self._presses[k](pose).contributions(geometry) - before
                found[3 * k + axis, at] = np.einsum("mpc,mc->pc", more, powers) / _POSE_STEP * gain[at]
            last = at.start
        return found

    def _seen(self, theta: FloatArray) -> FloatArray:
        """(99 m, len(theta)): derivatives of the lights' intrusion into the view; a light's numbers move it alone."""
        found = np.zeros((self._lights, 99, self._lights, 9))
        number = np.arange(self._lights)
        for k in range(9):
            move = np.append(np.tile(_STEP * np.eye(9)[k], self._lights), np.zeros(self.size - self._own + 1))
            more, less = (self._room.intrusion(self.geometry(theta + sign * move)) for sign in (1, -1))
            found[number, :, number, k] = (more - less) / (2 * _STEP * self._seen_mm)
        return np.pad(found.reshape(99 * self._lights, -1), ((0, 0), (0, self.size - self._own + 1)))

    def result(self, theta: FloatArray, steps: int) -> LightFit:
        basis, powers, geometry = self._solved(theta)
        miss = self._target.slope * (np.einsum("mpc,mc->pc", basis, powers) - self._target.signal)
        vignetting = float(self._vignetting + VIGNETTING * theta[self._own - 1])
        return LightFit(geometry, powers, vignetting, float(np.sqrt(np.mean(miss**2))), steps, self.poses(theta))

    def _solved(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, LightGeometry]:
        """Signals (m, n, 3) under lights of power 1, the best powers (m, 3), and the geometry; cached for one theta."""
        if self._cached is None or not np.array_equal(self._cached[0], theta):
            geometry = self.geometry(theta)
            gain = self._target.gain * self._vignette(theta)
            basis = contributions(self._gels(theta), geometry) * gain[None, :, None]
            self._cached = (theta.copy(), (basis, fit_powers(basis, self._target, self._shines), geometry))
        return self._cached[1]

    def _vignette(self, theta: FloatArray) -> FloatArray:
        return 1 - (self._vignetting + VIGNETTING * theta[self._own - 1]) * self._target.corner


def contributions(gels: Gels, lights: LightGeometry, alone: bool = False) -> FloatArray:
    """(m, n, 3): those of `LitGel` at the pixels of all gels."""
    return np.concatenate([gel.contributions(lights, alone) for gel in gels], axis=1)


def fit_powers(basis: FloatArray, target: Target, shines: BoolArray) -> FloatArray:
    """Powers (m, 3), by non-negative least squares per channel, of lights with signals (m, n, 3) at power 1."""
    powers = np.zeros((len(basis), 3))
    for channel in range(3):
        weight = target.slope[:, channel]
        lights = np.flatnonzero(shines[:, channel] & (basis[:, :, channel] * weight > 0).any(axis=1))
        if not len(lights):
            continue
        matrix = (basis[lights, :, channel] * weight).T
        scale = np.linalg.norm(matrix, axis=0)
        # The same problem in as many rows as unknowns, and one more for what no solution explains.
        both = np.column_stack([matrix / scale, target.signal[:, channel] * weight])
        factor = np.asarray(np.linalg.qr(both, mode="r"))
        powers[lights, channel] = nnls(factor[:, :-1], factor[:, -1])[0] / scale
    return powers
