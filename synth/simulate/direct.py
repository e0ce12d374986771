"""The back end for one press: answers the step policy with a sparse direct solver on a CPU."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from synth.press.load_path import LoadPath
from synth.simulate.contact_friction import Indenters
from synth.simulate.linear import norm
from synth.simulate.policy import requests as ask
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.policy.newton import NEAR
from synth.simulate.system import Residual, System, Unknowns
from synth.simulate.tables import pack_indenter, place_indenter
from synth.simulate.trajectory import Loads, State, Trajectory, at_rest

MAX_ROUGH_ITERATIONS = 5
"""Iterations after which directions are exact: far from the solution rough ones may not get there at all."""
ROUGH_ABOVE = 1e-5
"""A tolerance above it is reached with rough directions and earlier factors."""


@dataclass(frozen=True)
class Point:
    """An evaluated state."""

    state: Unknowns
    residual: Residual


@dataclass(frozen=True)
class Snapshot:
    """The iterate, what contact remembers, and its stiffness."""

    point: Point
    contact: dict[str, np.ndarray]
    stiffness: float


def led(policy: ask.Asking[ask.T], answer: Callable[[ask.Request], Any]) -> ask.T:
    """Answer a part of the policy until it ends; what it ends with."""
    answered = None
    while True:
        try:
            request = policy.send(answered)
        except StopIteration as end:
            return cast(ask.T, end.value)
        answered = answer(request)


class DirectSolver:
    """The equilibrium of one system under an indenter that stays where it is: all that Newton's method asks for."""

    def __init__(self, system: System, indenter: Indenters) -> None:
        self.system, self.indenter = system, indenter
        self._held = system.space.held.any(axis=1)
        self._direction = system.zero()
        self._origin = self._direction

    def start(self, state: Unknowns) -> ask.Evaluation:
        """Make a state the iterate."""
        self.iterate = self._evaluated(state)
        return self._seen(self.iterate)

    def answer(self, request: ask.Request) -> Any:
        """Do what the policy asks for, see `synth.simulate.policy.requests`."""
        match request:
            case ask.Solve():
                return self._solve(request)
            case ask.Try(share, viscosity):
                self._trial = self._evaluated(self.iterate.state.plus(self._direction, share))
                error = 0.0 if viscosity is None else self._error(share, viscosity)
                return replace(self._seen(self._trial), error=error)
            case ask.Do.TAKE:
                self.iterate = self._trial
            case ask.Do.KEEP_PASS:
                self._before_pass = self._snapshot()
                self._origin = self.iterate.state
            case ask.Do.RESTORE_PASS:
                self._restore(self._before_pass)
            case ask.Do.REPEAT:
                return self.start(self._before_pass.point.state)
            case ask.Do.ANCHOR:
                self._update_history(new_only=1)
        return None

    def _evaluated(self, state: Unknowns) -> Point:
        return Point(state, self.system.residual(state, self.indenter))

    def _seen(self, point: Point) -> ask.Evaluation:
        residual, moved = point.residual, point.state.u - self._origin.u
        return ask.Evaluation(
            free=norm(residual.free),
            forces=norm(residual.nodal_forces),
            reaction=norm(residual.nodal_forces[self._held]),
            smallest_jacobian=residual.smallest_jacobian,
            deepest_mm=residual.deepest,
            moved_mm=float(np.linalg.norm(moved, axis=1).max()),
        )

    def _solve(self, wanted: ask.Solve) -> bool:
        """The Newton direction: a rough one, by an earlier tangent's factor, where it needs not be exact."""
        newton, far = wanted.viscosity is None, wanted.relative > NEAR
        rough = newton and wanted.iteration < MAX_ROUGH_ITERATIONS and (wanted.tolerance > ROUGH_ABOVE or far)
        tangent = self.system.tangent(self.iterate.state, self.indenter, wanted.viscosity or 0.0, wanted.max_turn)
        reuse = rough or wanted.tolerance > ROUGH_ABOVE
        self._direction = self.system.newton_step(tangent, self.iterate.residual.free, rough, reuse)
        return bool(np.isfinite(self._direction.u).all())

    def _error(self, share: float, viscosity: float) -> float:
        """Norm of r(u + s δ) - (1 - s) r(u) + s θ L δ, what a step of relaxation leaves unpredicted, over r(u)'s."""
        iterate, trial = self.iterate, self._trial
        thick = self.system.viscous_force(iterate.state, trial.state, viscosity)
        missed = norm(trial.residual.free - (1 - share) * iterate.residual.free + thick)
        return missed / max(norm(iterate.residual.free), np.finfo(float).tiny)

    def _snapshot(self) -> Snapshot:
        return Snapshot(self.iterate, self.system.saved_contact(), float(self.indenter.stiffness.numpy()[0]))

    def _restore(self, kept: Snapshot) -> None:
        self.iterate = kept.point
        self.system.restore_contact(kept.contact)
        self.indenter.stiffness.fill_(kept.stiffness)

    def _update_history(self, new_only: int) -> None:
        iterate = self.iterate
        self.system.update_contact_history(iterate.state, iterate.residual, self.indenter, new_only)


class DirectPress(DirectSolver):
    """One press over a pad.

    Attributes:
        steps: the policy that leads it.
        state: displacement and pressure at the last accepted step.
        indenter: the body as the kernels take it, where it is.
        states: the recorded ones, the undeformed one first.
    """

    def __init__(self, system: System, path: LoadPath, friction: float, modulus_mpa: float, steps: LoadSteps) -> None:
        penalty = steps.numerics.penalty
        super().__init__(system, pack_indenter(path, friction, penalty))
        self.path, self.steps, self._modulus = path, steps, modulus_mpa
        self._sticking = pack_indenter(path, ask.STICK_FRICTION, penalty)
        self._sticking.centre, self._sticking.rotation = self.indenter.centre, self.indenter.rotation
        self._own_stiffness = float(self.indenter.stiffness.numpy()[0])
        self.state = self._previous = system.zero()
        self._at = self._target = 0.0
        self.states: list[State] = []

    def run(self, on_progress: Callable[[float], None] | None = None) -> Trajectory:
        """Follow the load path to its end or to its last good state; `on_progress` is told what share of it is done."""
        started = time.perf_counter()
        self.system.forget_factor()
        self.states = at_rest(self.path, self.system.space)

        def answer(request: ask.Request) -> Any:
            answer = self.answer(request)
            if on_progress is not None and request is ask.Do.ACCEPT and self._at > 0:
                on_progress(self._at / self.path.length_mm)
            return answer

        reason = led(self.steps.run(), answer)
        return Trajectory(tuple(self.states), reason, time.perf_counter() - started, self.system.space)

    def answer(self, request: ask.Request) -> Any:
        """Do what the policy asks for, see `synth.simulate.policy.requests`."""
        match request:
            case ask.Begin():
                return self._begin(request)
            case ask.Augment(share, stiffening):
                self.indenter.stiffness.fill_(stiffening * self._own_stiffness)
                self.system.augment(self.iterate.residual, self.indenter, share)
                return self.start(self.iterate.state)
            case ask.Do.FORCE:
                return float(self._forces()[0] @ self.path.direction)
            case ask.Record():
                self.states.append(self._recorded(request))
            case ask.Do.ACCEPT:
                self._previous, self.state, self._at = self.state, self.iterate.state, self._target
                self._update_history(new_only=0)
            case ask.Do.KEEP_STEP:
                self._after_step = self._snapshot()
            case ask.Do.RESTORE_STEP:
                self._restore(self._after_step)
                # What follows must not depend on which states were wanted.
                self.system.forget_factor()
            case _:
                return super().answer(request)
        return None

    def place(self, at_mm: float) -> None:
        """Move the indenter to a path length."""
        place_indenter(self.indenter, self.path.pose(at_mm))

    def _begin(self, wanted: ask.Begin) -> ask.Evaluation:
        """The first iterate of a step."""
        state, before = self.state, self._previous
        self._target = wanted.at_mm
        if wanted.rigid:
            state = self._rigid_motion(wanted.at_mm)
        elif wanted.ratio:
            state = state.plus(Unknowns(state.u - before.u, state.p - before.p), wanted.ratio)
        self.place(wanted.at_mm)
        return self.start(state)

    def _rigid_motion(self, target: float) -> Unknowns:
        """Rigid-motion predictor: the last state moved as if every touching point stuck to the indenter, linearised.

        From the last state itself a step of the indenter aside looks like sliding at every point, and in that regime
        Newton's method does not find the state where most points stick. The derivative along the path is taken over a
        small share of the step: over the whole of it the trial tractions of sticking points would be beyond linear. The
        residual of the state itself is subtracted: the division by that share would make it too large.
        """
        state, sticking = self.state, self._sticking
        self.place(self._at)
        tangent = self.system.tangent(state, sticking)
        before = self.system.residual(state, sticking).free
        self.place(self._at + ask.PATH_DERIVATIVE_STEP * (target - self._at))
        moved = self.system.residual(state, sticking).free - before
        step = self.system.newton_step(tangent, moved)
        return state.plus(step, 1 / ask.PATH_DERIVATIVE_STEP) if np.isfinite(step.u).all() else state

    def _forces(self) -> Loads:
        return self.system.forces(self.iterate.state, self.iterate.residual)

    def _recorded(self, wanted: ask.Record) -> State:
        """The iterate in the units of a trajectory."""
        pose = self.path.pose(wanted.at_mm)
        slip_ratio = self.system.slip_ratio(self.iterate.residual, self.indenter)
        return State.of(wanted, pose, self.iterate.state.u, self._forces(), self._modulus, slip_ratio)
