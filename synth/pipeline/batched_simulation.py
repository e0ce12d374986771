"""Trajectories simulated many at once.

Tasks are taken some chunks ahead, drawn, sorted by their pads, and run through the lanes of `synth.simulate.batched`;
an instance that fails is followed by its trajectory's next one in the next chunk. What a trajectory comes out as does
not depend on which others ran beside it.

The trajectories of one sensor are handed on together: its renderer is worth as much as some ten frames. Those that wait
for one of their sensor's are a few hundred kilobytes each.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import islice

import warp as wp

from synth.pipeline.attempts import Attempt, Attempts
from synth.pipeline.records import JobContext, Outcome, SimulatedTrajectory, Task
from synth.press.press import Press
from synth.sampling import SensorInstance, draw_sensor, sensor_of
from synth.scene import Gel
from synth.scene.template import Template
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.pad import Pad, prepare

BATCH = {"cuda": 256, "cpu": 8}
"""Trajectories at once."""
CHUNK = 4
"""Batches in a chunk of tasks that are drawn together: lanes are left empty at its end alone. The first
chunk is one batch, because nothing can be rendered before it has been drawn."""
MIN_PER_SENSOR = 16
"""Waiting trajectories of a sensor that are worth building its renderer for; a clip alone is."""

Result = SimulatedTrajectory | Outcome
"""A simulated trajectory, or the record of one whose every instance failed."""


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
        self.open: Counter[int] = Counter()

    def __iter__(self) -> Iterator[tuple[int, Result]]:
        if self._context.plan.solver_device == "cuda":  # on a new machine several modules compile at once
            wp.load_module("synth.simulate", "cuda", recursive=True)
        again: list[Attempts] = []
        most = self._batch
        while chunk := [*again, *self._begun(most - len(again))]:
            again, most = [], CHUNK * self._batch
            ready: dict[Gel, list[tuple[Attempts, Attempt]]] = {}
            for attempts in chunk:
                attempt = attempts.next(retry=False)
                if attempt is not None:
                    ready.setdefault(pad_key(attempt.press), []).append((attempts, attempt))
                elif attempts.is_exhausted:
                    yield attempts.trajectory, attempts.given_up()
                else:
                    again.append(attempts)
            while ready:
                members = ready.pop(next(iter(ready)))
                presses, frames = zip(*((attempt.press, attempt.frames) for _, attempt in members), strict=True)
                for number, result in simulate_presses(presses, self._pads.of(presses[0]), frames, self._batch):
                    attempts, attempt = members[number]
                    simulated = attempts.simulated(attempt, result)
                    if simulated is None:
                        again.append(attempts)
                    else:
                        yield attempts.trajectory, simulated

    def _begun(self, most: int) -> list[Attempts]:
        begun = []
        for task in islice(self._tasks, most):
            template = self._context.plan.template
            sensor = sensor_of(template, task[0])
            if self._sensor is None or self._sensor[0] != sensor:
                self._sensor = sensor, draw_sensor(template, self._context.job.seed, sensor)
            self.open[sensor] += 1
            begun.append(Attempts(self._context, task, self._sensor[1]))
        return begun


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
