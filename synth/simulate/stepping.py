"""Load stepping: move the indenter along its load path, recording converged states, halving steps that fail.

Each step starts from a linear extrapolation of the last two states; a relaxed tolerance is enough for it. At a state
that is wanted augmented-Lagrangian passes take penetration and elastic slip away, and the full tolerance holds; the
start of the passes, and the result of each but the last, need less, because the next one changes it
(MULTIPLIER_TOLERANCE). All of this is for what is recorded only: the path goes on from the intermediate state before,
because multipliers that stay behind on a moving contact upset Newton's method at sharp edges. An unconverged field is
never recorded: a press whose step would have to become shorter than SHORTEST_STEP ends at its last good state.
"""

import time
from collections.abc import Callable

import numpy as np

from synth.arrays import FloatArray
from synth.scene import Numerics
from synth.simulate.distance import KINDS
from synth.simulate.indenter import RigidBody
from synth.simulate.load_path import TOUCH_MM, LoadPath
from synth.simulate.newton import FORCE_FLOOR, MAX_ITERATIONS, Solution, relative_residual, relax, solve
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.posed_path import IN_GEL, PosedPath
from synth.simulate.system import System, Unknowns
from synth.simulate.tables import pack_indenter, place_indenter
from synth.simulate.trajectory import State, Trajectory, at_rest, no_contact, not_converged, too_deep

SHORTEST_STEP = 1 / 128
"""Shortest step, as a share of max_step_mm."""
MAX_PRESS_ITERATIONS = 2000
"""A step that fails after so many iterations of a press ends it; on a CPU no press that completed took as
many."""
MAX_ITERATIONS_TO_GROW = 7
"""Most iterations of a step that is followed by a longer one."""
GROWTH = 1.5
MAX_RELAXED_STEP = 1 / 4
"""A step that fails is relaxed (`synth.simulate.newton`) when it is at most this share of max_step_mm, and a pass
when it is less than this share of a whole update and begins deeper than DEEP."""
STICK_FRICTION = 1e6
"""Coefficient of friction at which nothing slides."""
PATH_DERIVATIVE_STEP = 1e-3
"""Share of a step over which the derivative along the load path is taken."""
MAX_MULTIPLIER_UPDATES = 2.0
"""Whole updates of the multipliers at a recorded state, in all. Not every contact point of a face on a curved body can
come to rest on the surface, so that more updates make the tractions uneven."""
FAILURES, MAX_FAILURES = 3, 8
"""Failed updates after which the passes end, the second number where they begin deeper than SINKING; an object's deeper
than DEEP go on. Updates are halved after a failure and doubled after a success: where a whole one upsets Newton's
method a part of it does not."""
DEEP = 0.02
"""Share of the press depth (at least 0.1 mm). A triangle mesh that penetrates by more gets up to MAX_DEEP_PASSES
passes, failed ones included. After the first success each pass doubles the contact stiffness, to at most
MAX_STIFFENING times the body's own: multipliers alone converge slowly at sharp edges (after Nocedal & Wright,
Numerical Optimization, framework 17.3). The press ends if that does not suffice."""
MAX_DEEP_PASSES, MAX_STIFFENING = 16, 8.0
SINKING, SUNK = 0.05, 0.2
"""Shares of the press depth (at least 0.1 mm). A press of another shape ends that would have to record a penetration by
more than the second: it bears on what cannot give way, such as a round gel's held rim."""
MULTIPLIER_TOLERANCE = 20.0
"""Tolerance of states that multipliers are updated from, over the full one: two updates do not forget what they began
with."""
PENETRATION = 2e-3
"""Passes end when no contact point is deeper inside the indenter than this share of the press depth."""
MAX_CORRECTION_RATIO = 3.0
"""A pass fails that moves a node, in any iteration, farther than so many times the deepest penetration, which is what
it is to take away: at edges that slip Newton's method can wander off to another equilibrium."""


def allowed_share(body: RigidBody) -> float:
    """Share of the press depth that a recorded state may penetrate."""
    return DEEP if body.kind == KINDS["mesh"] else SUNK


class Stepper:
    """Runs one press over a pad.

    Attributes:
        state: displacement and pressure at the last accepted step.
        indenter: the body as the kernels take it, where it is.
        at: path length (mm) of the last accepted step.
        step: length (mm) of the next step at most.
        next: number of the waypoint that comes next.
        states: the recorded ones, the undeformed one first.
        reason: why the press ended early, or nothing.
    """

    def __init__(
        self,
        system: System,
        path: LoadPath,
        friction: float,
        numerics: Numerics,
        modulus_mpa: float,
        options: SolverOptions = STANDARD,
        frames: frozenset[int] | None = None,
    ) -> None:
        """frames: numbers of the states that are wanted; the others are recorded as the path goes through them."""
        self.system, self.path, self.numerics, self.options = system, path, numerics, options
        self._relaxed_tolerance = max(options.relaxed_tolerance, numerics.tolerance)
        self._modulus, self._waypoints = modulus_mpa, path.waypoints().tolist()
        records = path.records().tolist()
        self._recorded = frozenset(records)
        self._corrected = frozenset(place for k, place in enumerate(records, 1) if frames is None or k in frames)
        self._shallow_mm = PENETRATION * path.depth_scale_mm
        self._deep_mm = DEEP * path.depth_scale_mm if path.body.kind == KINDS["mesh"] else np.inf
        self._allowed_mm = allowed_share(path.body) * path.depth_scale_mm
        self._rubs = friction > 0
        self.indenter, self._sticking = pack_indenter(path, friction), pack_indenter(path, STICK_FRICTION)
        self._sticking.centre, self._sticking.rotation = self.indenter.centre, self.indenter.rotation
        self.state = self._previous_state = system.zero()
        self.at, self.step, self.next = 0.0, numerics.max_step_mm, 0
        self._previous: float | None = None
        self._iterations = 0
        self.states: list[State] = []
        self.reason = ""

    def target(self) -> float:
        """Path length of the next step's end: equal steps of at most `step` to the next waypoint."""
        goal = float(self._waypoints[self.next])
        count = max(1, int(np.ceil((goal - self.at) / self.step - 1e-9)))
        return goal if count == 1 else self.at + (goal - self.at) / count

    def run(self, on_progress: Callable[[float], None] | None = None) -> Trajectory:
        """Follow the load path to its end or to its last good state; `on_progress` is told what share of it is done."""
        started = time.perf_counter()
        self._start()
        while self.next < len(self._waypoints) and not self.reason:
            self._advance()
            if on_progress is not None:
                on_progress(self.at / self._waypoints[-1])
        return Trajectory(tuple(self.states), self.reason, time.perf_counter() - started, self.system.space)

    def _start(self) -> None:
        """The undeformed state; a path that never touches stays in it and needs no solve."""
        self.system.forget_factor()
        self.states = at_rest(self.path, self.system.space)
        if not self.path.may_touch:
            self.next = len(self._waypoints)
        else:
            self._place(0.0)
            self.system.residual(self.state, self.indenter)
            self.system.update_contact_history(self.state, self.indenter)
            if isinstance(self.path, PosedPath) and self.system.deepest() > TOUCH_MM:
                self.reason = f"the object is {IN_GEL}"

    def _advance(self) -> None:
        """One step."""
        target = self.target()
        self._place(target)
        between = target in self._recorded or target not in self._waypoints
        tolerance = self._relaxed_tolerance if between else self.numerics.tolerance
        solution = self._counted(solve(self.system, self._predicted(target), self.indenter, tolerance))
        relaxed = not solution.converged and target - self.at <= MAX_RELAXED_STEP * self.numerics.max_step_mm
        if relaxed:
            solution = self._counted(relax(self.system, self.state, self.indenter, tolerance))
        good = solution.converged
        if good and target in self._recorded and not self._slipped_through(target, solution.state):
            good = self._record(solution, target)
        if good:
            self._previous_state, self.state = self.state, solution.state
            # After the record, whose passes must still see how far points slipped in this step.
            self.system.update_contact_history(self.state, self.indenter)
            self._lengthen(target, solution.iterations, relaxed)
        else:
            self._shorten(target, relaxed)

    def _counted(self, solution: Solution) -> Solution:
        """A solution, its iterations added to those since the last recorded state."""
        self._iterations += solution.iterations
        return solution

    def _slipped_through(self, target: float, state: Unknowns) -> bool:
        """Whether the indenter, at the end of its press, bears on nothing: it passed between the contact points.

        Ends the press, saying so.
        """
        pressed = target == self.path.press_mm and self.path.is_over(self.system.space.mesh.size_mm)
        if not pressed or self.system.forces(state)[0] @ self.path.direction > FORCE_FLOOR:
            return False
        self.reason = no_contact(target)
        return True

    def _place(self, at: float) -> None:
        place_indenter(self.indenter, self.path.pose(at))

    def _predicted(self, target: float) -> Unknowns:
        """First iterate: by extrapolation, after a turn by rigid motion; the last state if det F would not be > 0."""
        state, before = self.state, self._previous_state
        if self._previous is not None and not self.path.turns_between(self._previous, self.at):
            ratio = (target - self.at) / (self.at - self._previous)
            ahead = state.plus(Unknowns(state.u - before.u, state.p - before.p), ratio)
        elif self._rubs and self.at > 0:
            ahead = self._rigid_motion(target)
        else:
            return state
        return ahead if self.system.residual(ahead, self.indenter).smallest_jacobian > 0 else state

    def _rigid_motion(self, target: float) -> Unknowns:
        """Rigid-motion predictor: the last state moved as if every touching point stuck to the indenter, linearised.

        From the last state itself a step of the indenter aside looks like sliding at every point, and in that regime
        Newton's method does not find the state where most points stick. The derivative along the path is taken over a
        small share of the step: over the whole of it the trial tractions of sticking points would be beyond linear. The
        residual of the state itself is subtracted: the division by that share would make it too large.
        """
        state, sticking = self.state, self._sticking
        self._place(self.at)
        tangent = self.system.tangent(state, sticking)
        before = self.system.residual(state, sticking).free
        self._place(self.at + PATH_DERIVATIVE_STEP * (target - self.at))
        moved = self.system.residual(state, sticking).free - before
        step = self.system.newton_step(tangent, moved)
        self._place(target)
        return state.plus(step, 1 / PATH_DERIVATIVE_STEP) if np.isfinite(step.u).all() else state

    def _augmented(self, solution: Solution) -> Solution:
        """Passes of multiplier update and solve, by whole updates or as large a share of them as converges.

        Of two whole updates the last is solved to the full tolerance; passes that begin deeper than DEEP never are. The
        contact stiffness may end up raised; `_record` resets it.
        """
        between = min(self._relaxed_tolerance, MULTIPLIER_TOLERANCE * self.numerics.tolerance)
        share, done, failures, passes = 1.0, 0.0, 0, 0
        if self.system.deepest() > self._shallow_mm:
            solution = self._polished(solution, between)
        while solution.converged and self.system.deepest() > self._shallow_mm:
            deepest, sharpness = self.system.deepest(), float(self.indenter.sharpness.numpy()[0])
            deep = deepest > self._deep_mm
            allowed = MAX_FAILURES if deepest > SINKING * self.path.depth_scale_mm else FAILURES
            over = done >= MAX_MULTIPLIER_UPDATES or failures >= allowed
            if deep:
                over = passes >= MAX_DEEP_PASSES
            if over:
                break
            passes += 1
            before = self.system.saved_contact()
            if deep and done > 0:
                self.indenter.sharpness.fill_(min(2 * sharpness, MAX_STIFFENING * self.path.body.sharpness))
            self.system.augment(self.indenter, share)
            tolerance = between if deep or done + share < MAX_MULTIPLIER_UPDATES else self.numerics.tolerance
            start, limit, reach = solution.state, self.options.correction_iterations, MAX_CORRECTION_RATIO * deepest
            better = self._counted(solve(self.system, start, self.indenter, tolerance, limit, reach))
            relaxed = not better.converged and deep and share < MAX_RELAXED_STEP
            if relaxed:
                better = self._counted(relax(self.system, start, self.indenter, tolerance))
            if better.converged:
                solution, done = better, done + share
                share = min(1.0, 2 * share)
            else:
                self.system.restore_contact(before)
                self.indenter.sharpness.fill_(sharpness)
                self.system.residual(solution.state, self.indenter)
                failures, share = failures + 1, share / 2
        return solution

    def _polished(self, solution: Solution, limit: float) -> Solution:
        """A solution brought to a tolerance where it is not there yet."""
        if not solution.converged or relative_residual(solution.residual) <= limit:
            return solution
        return self._counted(solve(self.system, solution.state, self.indenter, limit, MAX_ITERATIONS))

    def _record(self, step: Solution, target: float) -> bool:
        """Record the corrected state, if it reaches the full tolerance, and put contact back for the path to go on.

        Returns whether it does. A state that is too deep is not recorded either, and ends the press, saying so.
        """
        saved = self.system.saved_contact()
        solution = step
        if target in self._corrected:
            self.system.update_contact_history(step.state, self.indenter, new_only=1)
            solution = self._augmented(step)
            if solution.converged and self.system.deepest() > self._allowed_mm:
                self.reason = too_deep(self.path.pose(target), allowed_share(self.path.body))
            else:
                solution = self._polished(solution, self.numerics.tolerance)
        if solution.converged and not self.reason:
            self.states.append(self._recorded_state(solution, target))
            self._iterations = 0
        self.indenter.sharpness.fill_(self.path.body.sharpness)
        self.system.restore_contact(saved)
        self.system.forget_factor()
        self.system.residual(step.state, self.indenter)
        return solution.converged

    def _recorded_state(self, solution: Solution, target: float) -> State:
        """A solution that was just found, in the units of a trajectory."""
        pose = self.path.pose(target)
        force, torque, traction = (self._modulus * value for value in self.system.forces(solution.state))
        return State(
            depth_mm=pose.depth_mm,
            shear_mm=pose.shear_mm,
            twist_deg=pose.twist_deg,
            displacement=solution.state.u,
            traction=traction,
            force_n=_triple(force),
            torque_nmm=_triple(torque),
            newton_iterations=self._iterations,
            residual=relative_residual(solution.residual),
            min_jacobian=solution.residual.smallest_jacobian,
            max_penetration_mm=self.system.deepest(),
            slip_ratio=self.system.slip_ratio(self.indenter),
        )

    def _lengthen(self, target: float, iterations: int, relaxed: bool) -> None:
        """After a good step: go on from its end, by a longer one if it was easy.

        Nothing is extrapolated across a relaxed step, which may have jumped.
        """
        taken = target - self.at
        self._previous, self.at = self.at if self.options.extrapolate and not relaxed else None, target
        if target == self._waypoints[self.next]:
            self.next += 1
        if iterations <= MAX_ITERATIONS_TO_GROW:
            self.step = min(self.numerics.max_step_mm, GROWTH * max(taken, self.step / GROWTH))

    def _shorten(self, target: float, relaxed: bool) -> None:
        """After a failure: half the step, a quarter if it was relaxed; and the end if that is too short or late."""
        self.step = (target - self.at) / (4 if relaxed else 2)
        self._previous = None
        spent = self._iterations + sum(state.newton_iterations for state in self.states)
        if self.step < SHORTEST_STEP * self.numerics.max_step_mm or spent > MAX_PRESS_ITERATIONS:
            self.reason = not_converged(target - self.at, self.path.pose(self.at))


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
