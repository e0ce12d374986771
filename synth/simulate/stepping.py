"""Load stepping: move the indenters along their paths, recording converged states, halving steps that fail.

Each step starts from a linear extrapolation of the last two states. On the way a loose tolerance is enough. At a state
that is wanted augmented-Lagrangian passes take penetration and elastic slip away, and the full tolerance holds; what
the passes begin from and what all but the last find needs less, because the next one changes it (MULTIPLIERS). All of
this is for what is recorded only: the path goes on from the loose state before, because multipliers that stay behind on
a moving contact upset Newton's method at sharp edges. An unconverged field is never recorded: a sample whose step would
have to become shorter than SHORTEST_STEP ends at its last good state.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.scene import Numerics
from synth.simulate.driver import STANDARD, Driver
from synth.simulate.memory import kept_contact, restore_contact
from synth.simulate.newton import MAX_ITERATIONS, NOTHING, Solution, relative_residual, solve
from synth.simulate.path import Path, Pose
from synth.simulate.relaxation import relax
from synth.simulate.system import System
from synth.simulate.tables import pack_indenters
from synth.simulate.trajectory import State, Trajectory, no_balance, no_contact, trajectory_of
from synth.simulate.unknowns import Unknowns

SHORTEST_STEP = 1 / 128
"""Shortest step, as a share of max_step_mm."""
EASY = 7
"""A step that took at most so many iterations is followed by a longer one."""
GROWTH = 1.5
RELAXED = 1 / 4
"""A step that fails is relaxed (`synth.simulate.relaxation`) when it is at most this share of max_step_mm."""
STUCK = 1e6
"""Coefficient of friction at which nothing slides."""
NUDGE = 1e-3
"""Share of a step over which the derivative along the path is taken."""
ENOUGH = 2.0
"""Whole updates of the multipliers at a recorded state, in all. On a face pressed on a curved body not every contact
point can come to rest on the surface: a third still moves a sphere's force by 0.1 %, and at a punch's rim it makes the
tractions uneven (P1/P1: a sliding punch's T / N off by 10 % with three, by 3 % with two)."""
FAILURES = 3
"""Of attempts at them, after which the passes end. Where a whole update upsets Newton's method (a ball pressed in by
60 %, blocks up to their edges) a part of it does not: halved after a failure and doubled after a success, updates took
that ball's penetration from 0.14 to 0.006 mm, and its force from 8 % too little to what finer meshes have."""
MULTIPLIERS = 20.0
"""Tolerance of states that multipliers are updated from, over the full one. Two updates do not forget what they began
with: from states as loose as the way (1e-3) the ends of two frictionless ways to one place differed by up to 6e-5 mm,
so by less than 1e-5."""
PENETRATION = 2e-3
"""Passes end when no contact point is deeper inside the indenter than this share of the press depth."""
REACH = 3.0
"""A pass fails that moves a node, in any iteration, farther than so many times the deepest penetration. It takes
penetration and elastic slip away; most move nodes by 0.5 to 1.4 times as much, a twisted ball by more than twice on the
way. At edges that slip Newton's method can wander by up to eight times as much and come to rest in another balance, or
not within its iterations, as rounding decides (docs/reports/batched_fem.md, Rounding)."""


@dataclass
class _Sample:
    """Where one sample of the batch is."""

    path: Path
    waypoints: FloatArray
    recorded: frozenset[float]
    corrected: frozenset[float]
    step: float
    next: int = 0
    at: float = 0.0
    previous: float | None = None
    iterations: int = 0
    states: list[State] = field(default_factory=list)
    reason: str = ""

    @property
    def finished(self) -> bool:
        return bool(self.reason) or self.next >= len(self.waypoints)

    def target(self) -> float:
        """Next stop: equal steps of at most `step` to the next waypoint."""
        goal = float(self.waypoints[self.next])
        count = max(1, int(np.ceil((goal - self.at) / self.step - 1e-9)))
        return goal if count == 1 else self.at + (goal - self.at) / count


class Stepper:
    """Runs a batch of paths over one pad."""

    def __init__(
        self,
        system: System,
        paths: Sequence[Path],
        friction: Sequence[float],
        numerics: Numerics,
        moduli_mpa: Sequence[float],
        driver: Driver = STANDARD,
        frames: frozenset[int] | None = None,
    ) -> None:
        """frames: numbers of the states that are wanted; the others are recorded as the way goes through them."""
        self.system, self.numerics, self.moduli, self.driver = system, numerics, moduli_mpa, driver
        self.samples = []
        for path in paths:
            records = path.records()
            wanted = records if frames is None else [record for k, record in enumerate(records, 1) if k in frames]
            recorded, corrected = (frozenset(map(float, places)) for places in (records, wanted))
            self.samples.append(_Sample(path, path.waypoints(), recorded, corrected, numerics.max_step_mm))
        self.rubs = np.array(friction) > 0
        self.indenters = pack_indenters(paths, friction, system.device)
        self.stuck = pack_indenters(paths, [STUCK] * len(paths), system.device)
        self.stuck.centre, self.stuck.rotation = self.indenters.centre, self.indenters.rotation
        self.state = system.zero()
        self.previous = system.zero()

    def run(self, on_way: Callable[[float], None] | None = None) -> list[Trajectory]:
        """Follow every path to its end or to its last good state; `on_way` is told what share all have done."""
        started = time.perf_counter()
        self._start()
        while not all(sample.finished for sample in self.samples):
            self._advance(np.array([not sample.finished for sample in self.samples]))
            if on_way is not None:
                on_way(min(sample.at / float(sample.waypoints[-1]) for sample in self.samples))
        seconds = (time.perf_counter() - started) / len(self.samples)
        return [trajectory_of(tuple(each.states), each.reason, seconds, self.system.space) for each in self.samples]

    def _start(self) -> None:
        """The undeformed states; a path that never touches stays in them and needs no solve."""
        self.system.begin()
        for sample in self.samples:
            sample.states = [self._rest(sample.path.pose(0.0))]
            if not sample.path.may_touch:
                for record in sample.path.records():
                    sample.states.append(self._rest(sample.path.pose(float(record))))
                sample.next = len(sample.waypoints)
        running = np.array([not sample.finished for sample in self.samples])
        if running.any():
            self._place([0.0] * len(self.samples))
            self.system.balance(self.state, self.indenters, running)
            self.system.settle(self.state, self.indenters, running)

    def _rest(self, pose: Pose) -> State:
        nodes, contact = len(self.system.space.points), len(self.system.space.surface_nodes)
        zero = (0.0, 0.0, 0.0)
        fields = np.zeros((nodes, 3)), np.zeros((contact, 3))
        return State(pose.depth_mm, pose.shear_mm, pose.twist_deg, *fields, zero, zero, 0, 0.0, 1.0, 0.0, 0.0)

    def _advance(self, active: BoolArray) -> None:
        """One step of every active sample."""
        targets = [sample.target() if active[s] else sample.at for s, sample in enumerate(self.samples)]
        self._place(targets)
        tight = np.array([t in s.waypoints and t not in s.recorded for s, t in zip(self.samples, targets, strict=True)])
        tolerance = np.where(tight, self.numerics.tolerance, self._loose())
        solution = solve(self.system, self._predicted(targets, active), self.indenters, active, tolerance)
        self._count(solution, active)
        short = np.array(targets) - [sample.at for sample in self.samples] <= RELAXED * self.numerics.max_step_mm
        relaxed = active & ~solution.converged & short
        if relaxed.any():
            solution = relax(self.system, self.state, self.indenters, relaxed, tolerance).where(relaxed, solution)
            self._count(solution, relaxed)
        good = solution.converged & active
        recording = good & np.array([t in sample.recorded for sample, t in zip(self.samples, targets, strict=True)])
        recording &= ~self._slipped_through(recording, targets, solution.state)
        if recording.any():
            good &= self._record(solution, recording, targets)
        self.previous = self.state.where(good, self.previous)
        self.state = solution.state.where(good, self.state)
        # After the record, whose passes must still see how far points slipped in this step.
        self.system.settle(self.state, self.indenters, good)
        for s in map(int, np.flatnonzero(active)):
            self._control(self.samples[s], targets[s], bool(good[s]), int(solution.iterations[s]), bool(relaxed[s]))

    def _count(self, solution: Solution, active: BoolArray) -> None:
        """Add the iterations of a solve to the active samples'."""
        for s in map(int, np.flatnonzero(active)):
            self.samples[s].iterations += int(solution.iterations[s])

    def _loose(self) -> float:
        """Tolerance on the way."""
        return max(self.driver.loose, self.numerics.tolerance)

    def _slipped_through(self, recording: BoolArray, targets: Sequence[float], state: Unknowns) -> BoolArray:
        """Samples whose indenter, at the end of its press, bears on nothing: it passed between the contact points.

        Ends them, saying so.
        """
        size = self.system.space.mesh.size_mm
        ending = np.array(
            [t == s.path.press_mm and s.path.is_over(size) for s, t in zip(self.samples, targets, strict=True)]
        )
        through = recording & ending
        if through.any():
            through &= self.system.forces(state)[0][:, 2] <= NOTHING
        for s in map(int, np.flatnonzero(through)):
            self.samples[s].reason = no_contact(targets[s])
        return through

    def _place(self, at: Sequence[float]) -> None:
        poses = [sample.path.pose(s) for sample, s in zip(self.samples, at, strict=True)]
        self.indenters.centre.assign(np.array([pose.centre for pose in poses]))
        self.indenters.rotation.assign(np.array([pose.rotation for pose in poses]))

    def _predicted(self, targets: Sequence[float], active: BoolArray) -> Unknowns:
        """Linear extrapolation, or after a turn the gel carried along; the last state where det F would not be > 0."""
        ratio, turned = np.zeros(len(self.samples)), np.zeros(len(self.samples), dtype=bool)
        for s in map(int, np.flatnonzero(active)):
            sample = self.samples[s]
            if sample.previous is not None and not sample.path.turns_between(sample.previous, sample.at):
                ratio[s] = (targets[s] - sample.at) / (sample.at - sample.previous)
            else:
                turned[s] = self.rubs[s] and sample.at > 0
        ahead = self.state.plus(Unknowns(self.state.u - self.previous.u, self.state.p - self.previous.p), ratio)
        if turned.any():
            ahead = self._carried(targets, turned).where(turned, ahead)
        elif not ratio.any():
            return self.state
        valid = self.system.balance(ahead, self.indenters, active).smallest_jacobian > 0
        return ahead.where(valid, self.state)

    def _carried(self, targets: Sequence[float], active: BoolArray) -> Unknowns:
        """The last state moved with the indenter as if every touching point stuck to it, to first order.

        From the last state itself a step of the indenter aside looks like sliding at every point, and in that regime
        Newton's method does not find the state where most points stick. The derivative along the path is taken over a
        small share of the step: over the whole of it the trial tractions of stuck points would be beyond linear.
        """
        state, stuck, here = self.state, self.stuck, [sample.at for sample in self.samples]
        self._place(here)
        tangent = self.system.tangent(state, stuck, active)
        unbalanced = self.system.balance(state, stuck, active).free
        self._place([at + NUDGE * (target - at) for at, target in zip(here, targets, strict=True)])
        moved = self.system.balance(state, stuck, active).free - unbalanced  # of a loose state 1 / NUDGE times too much
        step = self.system.newton_step(tangent, moved, active)
        self._place(targets)
        return state.plus(step, np.where(active & np.isfinite(step.u).all(axis=(1, 2)), 1 / NUDGE, 0.0))

    def _augmented(self, solution: Solution, wanted: BoolArray) -> Solution:
        """Passes of multiplier update and solve, by whole updates or as large a share of them as converges.

        The last of two whole updates is solved to the full tolerance; where the passes end before it, none is.
        """
        between = min(self._loose(), MULTIPLIERS * self.numerics.tolerance)
        count = len(wanted)
        pending, share, done, failures = wanted.copy(), np.ones(count), np.zeros(count), np.zeros(count)
        press = np.array([max(float(sample.path.corners[:, 0].max()), 0.1) for sample in self.samples])
        solution = self._polished(solution, wanted & (self.system.deepest() > PENETRATION * press), between)
        pending &= solution.converged
        while (pending := pending & (self.system.deepest() > PENETRATION * press)).any():
            before = kept_contact(self.system.contact)
            self.system.augment(self.indenters, np.where(pending, share, 0.0))
            tolerance = np.where(done + share < ENOUGH, between, self.numerics.tolerance)
            reach = REACH * self.system.deepest()
            better = self._solved_again(solution, pending, tolerance, self.driver.correction_iterations, reach)
            converged, failed = pending & better.converged, pending & ~better.converged
            if failed.any():
                restore_contact(self.system.contact, before, failed)
                self.system.balance(solution.state, self.indenters, failed)
            done, failures = done + np.where(converged, share, 0.0), failures + failed
            share = np.where(failed, share / 2, np.where(converged, np.minimum(1.0, 2 * share), share))
            pending &= (done < ENOUGH) & (failures < FAILURES)
            solution = better.where(converged, solution)
        return solution

    def _polished(self, solution: Solution, wanted: BoolArray, limit: float) -> Solution:
        """The wanted samples brought to a tolerance where they are not there yet; see `converged`."""
        rough = wanted & solution.converged & (relative_residual(solution.balance) > limit)
        if not rough.any():
            return solution
        better = self._solved_again(solution, rough, np.full(len(wanted), limit), MAX_ITERATIONS)
        return better.where(rough, solution)

    def _solved_again(
        self,
        solution: Solution,
        active: BoolArray,
        tolerance: FloatArray,
        limit: int,
        reach_mm: FloatArray | float = np.inf,
    ) -> Solution:
        """From a solution on, its iterations counted."""
        better = solve(self.system, solution.state, self.indenters, active, tolerance, limit, reach_mm)
        self._count(better, active)
        return better

    def _record(self, step: Solution, recording: BoolArray, targets: Sequence[float]) -> BoolArray:
        """Record the corrected states, then put contact back to where the path goes on.

        Returns:
            (B,) False where a corrected state does not reach the full tolerance: nothing is recorded there.
        """
        kept = kept_contact(self.system.contact)
        wanted = recording & np.array([t in s.corrected for s, t in zip(self.samples, targets, strict=True)])
        self.system.anchor(step.state, self.indenters, wanted)
        solution = self._polished(self._augmented(step, wanted), wanted, self.numerics.tolerance)
        lost = wanted & ~solution.converged
        force, torque, traction = self.system.forces(solution.state)
        residual, deepest = relative_residual(solution.balance), self.system.deepest()
        slipping = self.system.slip_ratio(self.indenters)
        for s in map(int, np.flatnonzero(recording & ~lost)):
            sample, pose = self.samples[s], self.samples[s].path.pose(targets[s])
            sample.states.append(
                State(
                    depth_mm=pose.depth_mm,
                    shear_mm=pose.shear_mm,
                    twist_deg=pose.twist_deg,
                    displacement=solution.state.u[s].copy(),
                    traction=self.moduli[s] * traction[s],
                    force_n=_triple(self.moduli[s] * force[s]),
                    torque_nmm=_triple(self.moduli[s] * torque[s]),
                    newton_iterations=sample.iterations,
                    residual=float(residual[s]),
                    min_jacobian=float(solution.balance.smallest_jacobian[s]),
                    max_penetration_mm=float(deepest[s]),
                    slip_ratio=float(slipping[s]),
                )
            )
            sample.iterations = 0
        restore_contact(self.system.contact, kept, recording)
        self.system.begin(recording)
        self.system.balance(step.state, self.indenters, recording)
        return ~lost

    def _control(self, sample: _Sample, target: float, good: bool, iterations: int, relaxed: bool) -> None:
        """Longer steps after easy ones; half the step after a failure, and the end below the shortest.

        Nothing is extrapolated across a relaxed step, which may have jumped.
        """
        longest = self.numerics.max_step_mm
        if good:
            taken = target - sample.at
            sample.previous, sample.at = sample.at if self.driver.extrapolate and not relaxed else None, target
            if target == sample.waypoints[sample.next]:
                sample.next += 1
            if iterations <= EASY:
                sample.step = min(longest, GROWTH * max(taken, sample.step / GROWTH))
        else:
            sample.step = (target - sample.at) / 2
            sample.previous = None
            if sample.step < SHORTEST_STEP * longest:
                sample.reason = no_balance(target - sample.at, sample.path.pose(sample.at))


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
