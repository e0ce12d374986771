"""Load stepping: move the indenters along their paths, recording converged states, halving steps that fail.

Each step starts from a linear extrapolation of the last two states. On the way a loose tolerance is enough; at a
recorded state the full one holds and augmented-Lagrangian passes take penetration and elastic slip away. The passes
correct what is recorded only: the path goes on from the state before them, because multipliers that stay behind on a
moving contact upset Newton's method at sharp edges. An unconverged field is never recorded: a sample whose step would
have to become shorter than SHORTEST_STEP ends at its last good state.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from synth.arrays import BoolArray, FloatArray
from synth.scene import Numerics
from synth.simulate.contact import Indenters
from synth.simulate.distance import KINDS, shape_vector
from synth.simulate.newton import Solution, relative_residual, solve
from synth.simulate.path import Path, Pose
from synth.simulate.system import System, Unknowns, warp_array
from synth.simulate.trajectory import State, Trajectory

LOOSE = 1e-3
"""Tolerance between recorded states (the error of these does not reach the recorded ones without friction)."""
SHORTEST_STEP = 1 / 128
"""Shortest step, as a share of max_step_mm."""
EASY = 7
"""A step that took at most so many iterations is followed by a longer one."""
GROWTH = 1.5
PASSES = 2
"""Most augmented-Lagrangian passes at a recorded state: on a linear face pressed on a curved body not every contact
point can come to rest on the surface, so that a third pass still moved a sphere's force by 0.1 % only."""
CORRECTION_ITERATIONS = 8
"""Newton iterations of one pass; a correction that needs more is dropped."""
PENETRATION = 2e-3
"""Passes end when no contact point is deeper inside the indenter than this share of the press depth."""


@dataclass
class _Sample:
    """Where one sample of the batch is."""

    path: Path
    waypoints: FloatArray
    recorded: frozenset[float]
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
    ) -> None:
        self.system, self.numerics, self.moduli = system, numerics, moduli_mpa
        self.samples = []
        for path in paths:
            waypoints = path.waypoints()
            waypoints = waypoints[waypoints > 0]
            sample = _Sample(path, waypoints, frozenset(map(float, path.records())), numerics.max_step_mm)
            self.samples.append(sample)
        self.indenters = _indenters(paths, friction, system.device)
        self.state = system.zero()
        self.previous = system.zero()

    def run(self) -> list[Trajectory]:
        """Follow every path to its end or to its last good state."""
        started = time.perf_counter()
        self._start()
        while not all(sample.finished for sample in self.samples):
            self._advance(np.array([not sample.finished for sample in self.samples]))
        seconds = (time.perf_counter() - started) / len(self.samples)
        return [_trajectory(sample, seconds) for sample in self.samples]

    def _start(self) -> None:
        """The undeformed states; a path that never touches stays in them and needs no solve."""
        for s, sample in enumerate(self.samples):
            rest = self._rest(sample.path.pose(0.0))
            sample.states = [rest]
            if len(sample.waypoints) == 0 or sample.path.press_mm == 0:
                for record in sample.path.records():
                    sample.states.append(self._rest(sample.path.pose(float(record))))
                sample.next = len(sample.waypoints)
            self.state.u[s] = 0.0

    def _rest(self, pose: Pose) -> State:
        nodes, contact = self.system.nodes, len(self.system.mesh.contact_nodes)
        zero = (0.0, 0.0, 0.0)
        return State(
            pose.depth_mm,
            pose.shear_mm,
            pose.twist_deg,
            np.zeros((nodes, 3)),
            np.zeros((contact, 3)),
            zero,
            zero,
            0,
            0.0,
            1.0,
            0.0,
        )

    def _advance(self, active: BoolArray) -> None:
        """One step of every active sample."""
        targets = [sample.target() if active[s] else sample.at for s, sample in enumerate(self.samples)]
        self._place(targets)
        arriving = np.array([s.finished or t in s.waypoints for s, t in zip(self.samples, targets, strict=True)])
        tolerance = np.where(arriving, self.numerics.tolerance, np.maximum(LOOSE, self.numerics.tolerance))
        solution = solve(self.system, self._predicted(targets, active), self.indenters, active, tolerance)
        for s in map(int, np.flatnonzero(active)):
            self.samples[s].iterations += int(solution.iterations[s])
        good = solution.converged & active
        self.previous = self.state.where(good, self.previous)
        self.state = solution.state.where(good, self.state)
        recording = good & np.array([t in sample.recorded for sample, t in zip(self.samples, targets, strict=True)])
        recording &= ~self._slipped_through(recording, targets)
        if recording.any():
            self._record(solution, recording, targets)
        # After the record, whose passes must still see how far points slipped in this step.
        self.system.settle(self.state, self.indenters, good)
        for s in map(int, np.flatnonzero(active)):
            self._control(self.samples[s], targets[s], bool(good[s]), int(solution.iterations[s]))

    def _slipped_through(self, recording: BoolArray, targets: Sequence[float]) -> BoolArray:
        """Samples whose indenter, pressing on the pad, passed between the contact points. Ends them, saying so."""
        untouched = recording & (self.system.deepest() == 0) & ~np.any(self.system.traction.numpy(), axis=(1, 2, 3))
        for s in map(int, np.flatnonzero(untouched)):
            sample = self.samples[s]
            untouched[s] = targets[s] <= sample.path.press_mm and self._is_over_pad(sample.path)
            if untouched[s]:
                sample.reason = (
                    f"pressed {targets[s]:.3g} mm deep, the indenter touches no contact point: it is too small for the "
                    "mesh or for the steps; lower numerics.edge_length_mm or numerics.max_step_mm"
                )
        return untouched

    def _is_over_pad(self, path: Path) -> bool:
        """Whether the body's lowest point, a ring's rim for a torus, comes down on the contact face."""
        rim = float(path.body.shape[1]) if path.body.kind == KINDS["torus"] else 0.0
        half = np.array(self.system.mesh.size_mm[:2]) / 2
        return bool(np.all(np.abs(path.motion.position_mm) + rim < half))

    def _place(self, at: Sequence[float]) -> None:
        poses = [sample.path.pose(s) for sample, s in zip(self.samples, at, strict=True)]
        self.indenters.centre.assign(np.array([pose.centre for pose in poses]))
        self.indenters.rotation.assign(np.array([pose.rotation for pose in poses]))

    def _predicted(self, targets: Sequence[float], active: BoolArray) -> Unknowns:
        """Linear extrapolation where it leaves every det F > 0, else the last state."""
        ratio = np.zeros(len(self.samples))
        for s in map(int, np.flatnonzero(active)):
            sample = self.samples[s]
            corner = sample.path.press_mm
            if sample.previous is not None and not sample.previous < corner <= sample.at:
                ratio[s] = (targets[s] - sample.at) / (sample.at - sample.previous)
        if not ratio.any():
            return self.state
        ahead = self.state.plus(Unknowns(self.state.u - self.previous.u, self.state.p - self.previous.p), ratio)
        valid = self.system.balance(ahead, self.indenters, active).smallest_jacobian > 0
        return ahead.where(valid, self.state)

    def _augmented(self, solution: Solution, recording: BoolArray) -> Solution:
        """Passes of multiplier update and solve; a pass that fails is dropped and ends the passes of its sample."""
        pending = recording.copy()
        tolerance = np.full(len(pending), self.numerics.tolerance)
        press = np.array([max(sample.path.press_mm, 0.1) for sample in self.samples])
        for _ in range(PASSES):
            pending &= self.system.deepest() > PENETRATION * press
            if not pending.any():
                break
            before = _copy(self.system.contact)
            self.system.augment(solution.state, self.indenters, pending)
            better = solve(self.system, solution.state, self.indenters, pending, tolerance, CORRECTION_ITERATIONS)
            for s in map(int, np.flatnonzero(pending)):
                self.samples[s].iterations += int(better.iterations[s])
            failed = pending & ~better.converged
            if failed.any():
                _restore(self.system.contact, before, failed)
                self.system.balance(solution.state, self.indenters, failed)
            solution = _merge(pending & better.converged, better, solution)
            pending &= better.converged
        return solution

    def _record(self, solution: Solution, recording: BoolArray, targets: Sequence[float]) -> None:
        """Record the corrected states, then put contact back to where the path goes on."""
        kept = _copy(self.system.contact)
        solution = self._augmented(solution, recording)
        force, torque, traction = self.system.forces(solution.state)
        residual, deepest = relative_residual(solution.balance), self.system.deepest()
        for s in map(int, np.flatnonzero(recording)):
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
                )
            )
            sample.iterations = 0
        _restore(self.system.contact, kept, recording)
        self.system.balance(self.state, self.indenters, recording)

    def _control(self, sample: _Sample, target: float, good: bool, iterations: int) -> None:
        """Longer steps after easy ones; half the step after a failure, and the end below the shortest."""
        longest = self.numerics.max_step_mm
        if good:
            taken = target - sample.at
            sample.previous, sample.at = sample.at, target
            if target == sample.waypoints[sample.next]:
                sample.next += 1
            if iterations <= EASY:
                sample.step = min(longest, GROWTH * max(taken, sample.step / GROWTH))
        else:
            sample.step = (target - sample.at) / 2
            sample.previous = None
            if sample.step < SHORTEST_STEP * longest:
                pose = sample.path.pose(sample.at)
                sample.reason = (
                    f"Newton's method found no balance {target - sample.at:.2g} mm beyond "
                    f"depth {pose.depth_mm:.3g} mm, shear {np.hypot(*pose.shear_mm):.3g} mm, "
                    f"twist {pose.twist_deg:.3g} deg"
                )


def _indenters(paths: Sequence[Path], friction: Sequence[float], device: str) -> Indenters:
    bodies = [path.body for path in paths]
    largest = np.max([body.coefficients.shape for body in bodies], axis=0)
    coefficients = np.zeros((len(bodies), *largest))
    for s, body in enumerate(bodies):
        i, j, k = body.coefficients.shape
        coefficients[s, :i, :j, :k] = body.coefficients
    packed = Indenters()
    packed.kind = warp_array(np.array([body.kind for body in bodies], dtype=np.int32), wp.int32, device)
    packed.shape = warp_array(np.array([body.shape for body in bodies]), shape_vector, device)
    packed.coefficients = warp_array(coefficients, wp.float64, device)
    packed.centre = wp.zeros(len(bodies), dtype=wp.vec3d, device=device)
    packed.rotation = wp.zeros(len(bodies), dtype=wp.mat33d, device=device)
    packed.friction = warp_array(np.array(friction, dtype=np.float64), wp.float64, device)
    return packed


def _trajectory(sample: _Sample, seconds: float) -> Trajectory:
    states = tuple(sample.states)
    if not sample.reason:
        return Trajectory(states, "complete", "", seconds)
    return Trajectory(states, "partial" if len(states) > 1 else "failed", sample.reason, seconds)


def _merge(mask: BoolArray, new: Solution, old: Solution) -> Solution:
    return Solution(
        state=new.state.where(mask, old.state),
        balance=type(old.balance)(
            np.where(mask[:, None], new.balance.free, old.balance.free),
            np.where(mask[:, None, None], new.balance.reaction, old.balance.reaction),
            np.where(mask, new.balance.smallest_jacobian, old.balance.smallest_jacobian),
        ),
        converged=old.converged,
        iterations=old.iterations,
        residual=np.where(mask, new.residual, old.residual),
    )


_CONTACT_FIELDS = ("normal", "tangent", "anchor", "anchored")


def _copy(contact: object) -> dict[str, np.ndarray]:
    return {name: getattr(contact, name).numpy().copy() for name in _CONTACT_FIELDS}


def _restore(contact: object, kept: dict[str, np.ndarray], mask: BoolArray) -> None:
    for name, before in kept.items():
        array = getattr(contact, name)
        now = array.numpy().copy()
        now[mask] = before[mask]
        array.assign(now)


def _triple(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
