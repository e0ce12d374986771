"""Many presses through the lanes of one solver: the entry point, and what the host does."""

import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np

from synth.press.press import Press
from synth.simulate.batched.lane import Lane
from synth.simulate.batched.lane_orders import Number
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.presses import trajectory
from synth.simulate.batched.solver import INNER_ITERATIONS, BatchedSolver
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.solve import check_shared
from synth.simulate.trajectory import Trajectory, at_rest

Asked = tuple[Press, frozenset[int] | None]
"""A press, and the numbers of the states that are wanted of it, else all."""
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
    the pad's materials and, but for the penalty, its numerics, else InputError; the pad is of
    `synth.simulate.batched.pad.prepare`. At most `batch` trajectories run at a time, and an iterator is asked for a few
    more whenever some have ended, even if it had none the last time. `options` hold along the load paths.
    """
    numbered = map(partial(_checked, pad), enumerate(asked))
    waiting = list(islice(numbered, batch))
    while waiting:
        run = Run(waiting, numbered, pad, options)
        yield from run
        waiting = [*run.waiting, *islice(numbered, batch - len(run.waiting))]


def _checked(pad: Pad, numbered: tuple[int, Asked]) -> tuple[int, Asked]:
    check_shared([pad.scene, numbered[1][0].scene], pad.space.mesh)
    return numbered


class Run:
    """Presses, by their numbers, in the lanes of a solver: the first ones, as many as there are lanes, and then more.

    The first ones say how many states a lane can record, and how large a distance grid can be. `waiting` are presses
    that have not begun; if one needs more room, the run ends with it still waiting.
    """

    def __init__(
        self,
        first: Sequence[tuple[int, Asked]],
        more: Iterator[tuple[int, Asked]],
        pad: Pad,
        options: SolverOptions,
        inner: int = INNER_ITERATIONS,
    ) -> None:
        self._more, self._pad, self._options = more, pad, options
        self.waiting = deque(first)
        batch = len(first)
        self._room = tuple(np.max([_room(press) for _, (press, _) in first], axis=0).tolist())
        records, *grid = self._room
        self.solver = BatchedSolver(pad, batch, records, (grid[0], grid[1], grid[2]), inner)
        self._orders = np.zeros(batch, dtype=np.int32)
        self._numbers = np.zeros((batch, len(Number)))
        self.lanes: list[Lane | None] = [None] * batch
        self.cycles = 0
        self._untouched: list[tuple[int, Trajectory]] = []

    def __iter__(self) -> Iterator[tuple[int, Trajectory]]:
        """Run all presses."""
        begun, spent = np.zeros(self.solver.batch), 0.0
        while True:
            began = time.perf_counter()
            begun[self._fill()] = spent
            untouched, self._untouched = self._untouched, []
            yield from untouched
            if not any(self.lanes):
                return
            ended = self.advance()
            over = [(s, lane, self.solver.recorded(s, len(lane.records))) for s, lane in ended]
            spent += time.perf_counter() - began  # without what whoever takes the results does meanwhile
            for s, lane, fields in over:
                self.lanes[s] = None
                seconds = float(spent - begun[s]) / self.solver.batch
                result = trajectory(lane.press, lane.records, fields, lane.reason, seconds, self._pad.space)
                yield lane.number, result

    def advance(self) -> list[tuple[int, Lane]]:
        """One cycle, and what the lanes are told to do in the next; the lanes that have ended, with their numbers."""
        self.solver.begin_cycle(self._orders, self._numbers)
        if len(self.waiting) < min(AHEAD, self.solver.batch):  # while a GPU is at work
            self.waiting += islice(self._more, 1)
        seen = self.solver.seen().tolist()
        self.cycles += 1
        working = [(s, lane) for s, lane in enumerate(self.lanes) if lane is not None]
        ended = [(s, lane) for s, lane in working if lane.ended]
        for s, lane in working:  # a lane that ends now still has orders for the next cycle
            self._orders[s] = 0 if lane.ended else lane.advance(seen[s])
        return ended

    def _fill(self) -> list[int]:
        """Begin presses in empty lanes; these lanes."""
        begun: dict[int, Press] = {}
        for s in (s for s, lane in enumerate(self.lanes) if lane is None):
            asked = self._next()
            if asked is None:
                break
            number, (press, frames) = asked
            lane = Lane(number, press, self._steps(press, frames), self._numbers[s], self._options.forcing)
            begun[s], self.lanes[s], self._orders[s] = press, lane, lane.first
        if begun:
            self.solver.fill(begun)
        return list(begun)

    def _next(self) -> tuple[int, Asked] | None:
        """The next press that touches the gel, if there is room for it; those that do not are over at once."""
        while True:
            self.waiting += islice(self._more, 0 if self.waiting else 1)
            if not self.waiting:
                return None
            number, (press, _) = self.waiting[0]
            if press.path.may_touch:
                fits = all(needs <= there for needs, there in zip(_room(press), self._room, strict=True))
                return self.waiting.popleft() if fits else None
            self.waiting.popleft()
            rest = tuple(at_rest(press.path, self._pad.space))
            self._untouched.append((number, Trajectory(rest, "", 0.0, self._pad.space)))

    def _steps(self, press: Press, wanted: frozenset[int] | None) -> LoadSteps:
        scene, options = press.scene, self._options
        given = (press.mesh.size_mm, scene.contact.friction > 0, scene.numerics, options)
        return LoadSteps(press.path, *given, wanted, options.closer)


def _room(press: Press) -> tuple[int, ...]:
    """States that a press records, and the counts of its distance grid."""
    return len(press.path.records()), *press.path.body.coefficients.shape
