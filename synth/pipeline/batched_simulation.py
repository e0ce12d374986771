"""Trajectories simulated many at once.

Tasks are drawn as the lanes of `synth.simulate.batched` ask for presses, and sorted by their pads; an instance that
fails is followed by its trajectory's next one. What a trajectory comes out as does not depend on which others ran
beside it.

The trajectories of one sensor are handed on together: its renderer is worth as much as some ten frames. Those that wait
for one of their sensor's are a few hundred kilobytes each.
"""

import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import count, islice

import warp as wp

from synth.pipeline.attempts import Attempt, Attempts
from synth.pipeline.records import JobContext, Outcome, SimulatedTrajectory, Task
from synth.press.press import Press
from synth.sampling import SensorInstance, draw_sensor, sensor_of
from synth.scene import Gel
from synth.scene.template import Template
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.batched.run import Asked

BATCH = {"cuda": 256, "cpu": 8}
"""Trajectories at once."""
MOST_DRAWN = 4
"""Batches of presses that wait for another pad, at most, before lanes are left empty."""
MIN_PER_SENSOR = 16
"""Waiting trajectories of a sensor that are worth building its renderer for; a clip alone is."""

Result = SimulatedTrajectory | Outcome
"""A simulated trajectory, or the record of one whose every instance failed."""
Drawn = tuple[Attempts, Attempt]


class Pads:
    """The pad that was used last: mesh, tables and preconditioner, which take seconds to prepare."""

    def __init__(self, context: JobContext) -> None:
        self._device = context.plan.solver_device
        self._cached: tuple[Gel, Pad] | None = None

    def of(self, press: Press) -> Pad:
        """The pad of a press; InputError for a mesh that allows no element, or CUDA without cuBLAS or cuSOLVER."""
        key = pad_key(press)
        if self._cached is None or self._cached[0] != key:
            self._cached = None  # gives its memory back first
            self._cached = key, prepare(press.scene, press.mesh, self._device)
        return self._cached[1]


def pad_key(press: Press) -> Gel:
    """What presses that may run together have in common, and with it the mesh. Without layers stiffness only scales."""
    gel = press.scene.sensor.gel
    return gel if gel.layers else gel.model_copy(update={"youngs_modulus_kpa": 1.0})


def in_batches(context: JobContext, tasks: Iterator[Task], batch: int | None) -> Iterator[list[Result]]:
    """Simulate tasks; each comes out once, in no particular order, in groups of one sensor's trajectories.

    At most `batch` trajectories run at a time, which on a CPU changes no bit of what comes out. InputError where the
    storage refuses, or for CUDA without cuBLAS or cuSOLVER.
    """
    simulation = _Simulation(context, tasks, batch or BATCH[context.plan.solver_device])
    return by_sensor(context.plan.template, simulation, simulation.open)


class _Simulation:
    """An iterator over (trajectory, its result) as they end; `open` counts those of each sensor that are under way."""

    def __init__(self, context: JobContext, tasks: Iterator[Task], batch: int) -> None:
        self._context, self._tasks, self._batch = context, tasks, batch
        self._pads = Pads(context)
        self._sensor: tuple[int, SensorInstance] | None = None
        self._again: list[Attempts] = []
        self._given_up: list[Attempts] = []
        self._drawn: dict[Gel, deque[Drawn]] = {}
        self.open: Counter[int] = Counter()

    def __iter__(self) -> Iterator[tuple[int, Result]]:
        if self._context.plan.solver_device == "cuda":  # on a new machine several modules compile at once
            wp.load_module("synth.simulate", "cuda", recursive=True, max_workers=os.cpu_count() or 1)
        while self._drawn or self._draw():
            for gel in islice(self._drawn, 1):
                presses = _OfOnePad(partial(self._next, gel))
                pad = self._pads.of(self._drawn[gel][0][1].press)
                for number, result in simulate_presses(presses, pad, self._batch):
                    attempts, attempt = presses.under_way.pop(number)
                    simulated = attempts.simulated(attempt, result)
                    if simulated is None:
                        self._again.append(attempts)
                    else:
                        yield attempts.trajectory, simulated
            while self._given_up:
                attempts = self._given_up.pop()
                yield attempts.trajectory, attempts.given_up()

    def _next(self, gel: Gel) -> Drawn | None:
        """The next press of a pad; None when there is none, or enough of other pads have been drawn meanwhile."""
        while gel not in self._drawn:
            if sum(map(len, self._drawn.values())) >= MOST_DRAWN * self._batch or not self._draw():
                return None
        members = self._drawn[gel]
        found = members.popleft()
        if not members:
            del self._drawn[gel]
        return found

    def _draw(self) -> bool:
        """Draw an instance, of a trajectory whose last one failed if there is one; False when none is left."""
        if not self._again and not self._begin():
            return False
        attempts = self._again.pop()
        attempt = attempts.next(retry=False)
        if attempt is not None:
            self._drawn.setdefault(pad_key(attempt.press), deque()).append((attempts, attempt))
        elif attempts.is_exhausted:
            self._given_up.append(attempts)
        else:
            self._again.append(attempts)
        return True

    def _begin(self) -> bool:
        task = next(self._tasks, None)
        if task is None:
            return False
        template = self._context.plan.template
        sensor = sensor_of(template, task[0])
        if self._sensor is None or self._sensor[0] != sensor:
            self._sensor = sensor, draw_sensor(template, self._context.job.seed, sensor)
        self.open[sensor] += 1
        self._again.append(Attempts(self._context, task, self._sensor[1]))
        return True


class _OfOnePad:
    """Presses of one pad, drawn when they are asked for; `under_way` has what was drawn, by the press's number."""

    def __init__(self, draw: Callable[[], Drawn | None]) -> None:
        self._draw, self._numbers = draw, count()
        self.under_way: dict[int, Drawn] = {}

    def __iter__(self) -> "_OfOnePad":
        return self

    def __next__(self) -> Asked:
        """The next one; after StopIteration there may be another, since a press that fails is followed by one."""
        drawn = self._draw()
        if drawn is None:
            raise StopIteration
        self.under_way[next(self._numbers)] = drawn
        return drawn[1].press, drawn[1].frames


def by_sensor(template: Template, ended: Iterable[tuple[int, Result]], open: Counter[int]) -> Iterator[list[Result]]:
    """Results of one sensor together, when enough or all of them are there.

    `open` says how many of each sensor are still to come; it is counted down.
    """
    waiting: dict[int, list[Result]] = {}
    enough = 1 if template.sampling.kind == "clips" else MIN_PER_SENSOR
    for trajectory, result in ended:
        sensor = sensor_of(template, trajectory)
        open[sensor] -= 1
        mine = waiting.setdefault(sensor, [])
        mine.append(result)
        if len(mine) >= enough or open[sensor] == 0:
            yield waiting.pop(sensor)
