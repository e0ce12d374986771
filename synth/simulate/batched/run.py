"""Many presses through the lanes of one solver: the entry point, and what the host does."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from synth.press.press import Press
from synth.simulate.batched.lane import Lane
from synth.simulate.batched.lanes import Number
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.presses import press_tables, trajectory
from synth.simulate.batched.solver import INNER_ITERATIONS, BatchedSolver
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.solve import check_shared
from synth.simulate.trajectory import Trajectory, at_rest

MAX_BATCH = 512
OPTIONS = replace(STANDARD, relaxed_tolerance=0.0, forcing=1e-4, closer=1e-3)
"""The scene's tolerance along the whole load path, because friction remembers the path; linear solves and corrections
so tight that rounding hardly ever decides which equilibrium is found."""


def simulate_presses(
    presses: Sequence[Press],
    pad: Pad,
    frames: Sequence[frozenset[int]] | None = None,
    batch: int = MAX_BATCH,
    options: SolverOptions = OPTIONS,
) -> Iterator[tuple[int, Trajectory]]:
    """Simulate presses into pads of one mesh, each as if it were alone; their numbers and trajectories, as they end.

    The presses share the pad's materials and, but for the penalty, its numerics, else InputError; the pad is of
    `synth.simulate.batched.pad.prepare`. `frames` are the numbers of the states that are wanted, of each press (else
    ValueError), see `synth.simulate.simulate_press`; at most `batch` trajectories run at a time; `options` hold along
    the load paths.
    """
    if frames is not None and len(frames) != len(presses):
        raise ValueError(f"{len(frames)} sets of frames for {len(presses)} presses")
    check_shared([pad.scene, *(press.scene for press in presses)], pad.space.mesh)
    touching = []
    for number, press in enumerate(presses):
        if press.path.may_touch:
            touching.append(number)
        else:
            yield number, Trajectory(tuple(at_rest(press.path, pad.space)), "", 0.0, pad.space)
    if touching:
        theirs = None if frames is None else [frames[n] for n in touching]
        run = Run([presses[n] for n in touching], pad, theirs, min(batch, len(touching)), options)
        for number, result in run:
            yield touching[number], result


class Run:
    """Presses in the lanes of a solver, in the order given, which is by default theirs."""

    def __init__(
        self,
        presses: Sequence[Press],
        pad: Pad,
        frames: Sequence[frozenset[int]] | None,
        batch: int,
        options: SolverOptions,
        order: Iterable[int] | None = None,
        inner: int = INNER_ITERATIONS,
    ) -> None:
        self._presses, self._pad, self._frames, self._options = presses, pad, frames, options
        table, grid = press_tables(presses, pad.device)
        records = max(len(press.path.records()) for press in presses)
        self.solver = BatchedSolver(pad, table, batch, records, grid, inner)
        self._waiting = iter(range(len(presses)) if order is None else order)
        self._orders = np.zeros(batch, dtype=np.int32)
        self._numbers = np.zeros((batch, len(Number)))
        self.lanes: list[Lane | None] = [None] * batch
        self.cycles = 0

    def __iter__(self) -> Iterator[tuple[int, Trajectory]]:
        """Run all presses."""
        begun = np.zeros(self.solver.batch)
        spent = 0.0
        empty: Sequence[int] = range(self.solver.batch)
        while True:
            began = time.perf_counter()
            self._fill(empty)
            begun[empty] = spent
            if not any(self.lanes):
                return
            ended = self.advance()
            over = [(s, lane, self.solver.recorded(s, len(lane.records))) for s, lane in ended]
            spent += time.perf_counter() - began  # without what whoever takes the results does meanwhile
            for s, lane, fields in over:
                seconds = float(spent - begun[s]) / self.solver.batch
                press = self._presses[lane.press]
                yield lane.press, trajectory(press, lane.records, fields, lane.reason, seconds, self._pad.space)
            empty = [s for s, _ in ended]

    def advance(self) -> list[tuple[int, Lane]]:
        """One cycle, and what the lanes are told to do in the next; the lanes that have ended, with their numbers."""
        seen = self.solver.cycle(self._orders, self._numbers).tolist()
        self.cycles += 1
        working = [(s, lane) for s, lane in enumerate(self.lanes) if lane is not None]
        ended = [(s, lane) for s, lane in working if lane.ended]
        for s, lane in working:  # a lane that ends now still has orders for the next cycle
            self._orders[s] = 0 if lane.ended else lane.advance(seen[s])
        return ended

    def _fill(self, empty: Sequence[int]) -> None:
        """Begin presses in empty lanes."""
        if not empty:
            return
        assignment = np.full(self.solver.batch, -1)
        for s in empty:
            number = next(self._waiting, None)
            assignment[s], self.lanes[s], self._orders[s] = -2, None, 0
            if number is not None:
                lane = Lane(number, self._steps(number), self._numbers[s], self._options.forcing)
                assignment[s], self.lanes[s], self._orders[s] = number, lane, lane.first
        self.solver.fill(assignment)

    def _steps(self, number: int) -> LoadSteps:
        press = self._presses[number]
        wanted = None if self._frames is None else self._frames[number]
        scene, mesh = press.scene, press.mesh
        return LoadSteps(
            press.path,
            mesh.size_mm,
            scene.contact.friction > 0,
            scene.numerics,
            self._options,
            wanted,
            self._options.closer,
        )
