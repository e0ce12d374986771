"""Many presses through the lanes of two solvers that take turns: the entry point, and what the host does."""

import time
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np

from synth.errors import InputError
from synth.press.press import Press
from synth.simulate.batched.lane import Lane
from synth.simulate.batched.lane_orders import Number
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.presses import trajectory
from synth.simulate.batched.solver import BatchedSolver
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.solve import check_shared
from synth.simulate.trajectory import Trajectory, at_rest

Asked = tuple[Press, frozenset[int] | None]
"""A press, and the numbers of the states that are wanted of it, else all."""
Numbered = tuple[int, Asked]
RUNS = 2
"""Runs that take turns: a GPU is at work on one's lanes while the host leads the other's."""
LARGE = 30_000
"""Unknowns from which on one run has all lanes: to read the inverse takes longer than the host does, for half of them
as long as for all."""
MAX_BATCH = 512
AHEAD = 8
"""Presses that wait for a lane, at most: more than end in a cycle, and few enough to be made beside its work."""
OPTIONS = replace(STANDARD, relaxed_tolerance=0.0, forcing=1e-4, closer=1e-3)
"""The scene's tolerance along the whole load path, because friction remembers the path; linear solves and corrections
so tight that rounding hardly ever decides which equilibrium is found."""


def simulate_presses(
    asked: Iterable[Asked], pad: Pad, batch: int = MAX_BATCH, options: SolverOptions = OPTIONS
) -> Iterator[tuple[int, Trajectory]]:
    """Simulate presses into pads of one mesh, each as if it were alone; their numbers and trajectories, as they end.

    A press comes with the numbers of the states that are wanted, see `synth.simulate.simulate_press`. The presses share
    the pad's mesh, materials and, but for the penalty, its numerics, else InputError; the pad is of
    `synth.simulate.batched.pad.prepare`. At most `batch` trajectories run at a time, and an iterator is asked for a few
    more whenever some have ended, even if it had none the last time. `options` hold along the load paths.
    """
    more, waiting = map(partial(_checked, pad), enumerate(asked)), deque[Numbered]()
    runs: list[Run | None] = [None] * min(RUNS if len(pad.free) < LARGE else 1, batch)
    lanes = batch // len(runs)
    while True:
        for k, run in enumerate(runs):
            if run is None:
                waiting += islice(more, max(0, lanes - len(waiting)))
                if not waiting or (len(waiting) < lanes and any(runs)):
                    continue
                run = Run(waiting, more, lanes, pad, options)
            yield from run.turn()
            runs[k] = run if any(run.lanes) else None
        if not any(runs):
            waiting += islice(more, 0 if waiting else 1)
            if not waiting:
                return


def _checked(pad: Pad, numbered: Numbered) -> Numbered:
    press, mesh = numbered[1][0], pad.space.mesh
    check_shared([pad.scene, press.scene], mesh)
    if not np.array_equal(press.mesh.points, mesh.points):
        raise InputError("the presses of a batch must share a mesh")
    return numbered


class Run:
    """Presses in the lanes of a solver: those that are `waiting`, at most so many at a time, and then `more`.

    The first ones say how many states a lane can record, and how large a distance grid can be. If one needs more room,
    the run ends with it still waiting. `lanes` are those of the solver, None where no press is under way.
    """

    def __init__(
        self, waiting: deque[Numbered], more: Iterator[Numbered], lanes: int, pad: Pad, options: SolverOptions
    ) -> None:
        self._waiting, self._more, self._pad, self._options = waiting, more, pad, options
        batch = min(lanes, len(waiting))
        self._room = tuple(np.max([_room(press) for _, (press, _) in islice(waiting, batch)], axis=0).tolist())
        records, *grid = self._room
        self.solver = BatchedSolver(pad, batch, records, (grid[0], grid[1], grid[2]))
        self._orders = np.zeros(batch, dtype=np.int32)
        self._numbers = np.zeros((batch, len(Number)))
        self.lanes: list[Lane | None] = [None] * batch
        self._begun, self._spent = np.zeros(batch), 0.0

    def turn(self) -> Iterator[tuple[int, Trajectory]]:
        """Wait for the cycle that is under way, begin presses in lanes that have ended, and begin a cycle.

        What has ended is made ready, and may be used, beside it.
        """
        began = time.perf_counter()
        over = [(s, lane, self.solver.recorded(s, len(lane.records))) for s, lane in self._ended()]
        begun = self._begun.tolist()
        for s, *_ in over:
            self.lanes[s] = None
        untouched = self._fill()
        if any(self.lanes):
            self.solver.begin_cycle(self._orders, self._numbers)
        self._spent += time.perf_counter() - began  # without what whoever takes the results does meanwhile
        yield from untouched
        for s, lane, fields in over:
            seconds = (self._spent - begun[s]) / self.solver.batch
            yield lane.number, trajectory(lane.press, lane.records, fields, lane.reason, seconds, self._pad.space)

    def _ended(self) -> list[tuple[int, Lane]]:
        """Wait for the cycle, if there is one, and ask what the lanes are to do next; those that have ended."""
        working = [(s, lane) for s, lane in enumerate(self.lanes) if lane is not None]
        if not working:
            return []
        if len(self._waiting) < min(AHEAD, self.solver.batch):  # while a GPU is at work
            self._waiting += islice(self._more, 1)
        seen = self.solver.seen().tolist()
        ended = [(s, lane) for s, lane in working if lane.ended]
        for s, lane in working:  # a lane that ends now still has orders for the next cycle
            self._orders[s] = 0 if lane.ended else lane.advance(seen[s])
        return ended

    def _fill(self) -> list[tuple[int, Trajectory]]:
        """Begin presses in empty lanes; results of those that touch nothing."""
        begun: dict[int, Press] = {}
        untouched: list[tuple[int, Trajectory]] = []
        for s in (s for s, lane in enumerate(self.lanes) if lane is None):
            asked = self._next(untouched)
            if asked is None:
                break
            number, (press, frames) = asked
            lane = Lane(number, press, self._steps(press, frames), self._numbers[s], self._options.forcing)
            begun[s], self.lanes[s], self._orders[s], self._begun[s] = press, lane, lane.first, self._spent
        if begun:
            self.solver.fill(begun)
        return untouched

    def _next(self, untouched: list[tuple[int, Trajectory]]) -> Numbered | None:
        """The next press that touches the gel, if there is room for it; those that do not are over at once."""
        while True:
            self._waiting += islice(self._more, 0 if self._waiting else 1)
            if not self._waiting:
                return None
            number, (press, _) = self._waiting[0]
            if press.path.may_touch:
                fits = all(needs <= there for needs, there in zip(_room(press), self._room, strict=True))
                return self._waiting.popleft() if fits else None
            self._waiting.popleft()
            rest = tuple(at_rest(press.path, self._pad.space))
            untouched.append((number, Trajectory(rest, "", 0.0, self._pad.space)))

    def _steps(self, press: Press, wanted: frozenset[int] | None) -> LoadSteps:
        scene, options = press.scene, self._options
        given = (press.mesh.size_mm, scene.contact.friction > 0, scene.numerics, options)
        return LoadSteps(press.path, *given, wanted, options.closer)


def _room(press: Press) -> tuple[int, ...]:
    """States that a press records, and the counts of its distance grid."""
    return len(press.path.records()), *press.path.body.coefficients.shape
