"""Trajectories simulated many at once.

Tasks are drawn as the lanes of `synth.simulate.batched` ask for presses, and sorted by their pads; an instance that
fails is followed by its trajectory's next one. What a trajectory comes out as does not depend on which others ran
beside it. Bodies from files take some tenths of a second each; beside a GPU, processes make those of first instances.

The trajectories of one sensor are handed on together: its renderer is worth as much as some ten frames. Those that wait
for one of their sensor's are a few hundred kilobytes each.
"""

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from functools import partial
from itertools import count, islice

from synth.pipeline.attempts import Attempt, Attempts
from synth.pipeline.pads import Pads, pad_key
from synth.pipeline.records import JobContext, Outcome, SimulatedTrajectory, Task
from synth.pipeline.worker_pool import Maker, cores, spread
from synth.sampling import SensorInstance, draw_sensor, sensor_of
from synth.scene import Gel, MeshIndenter
from synth.scene.template import Template
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.pad import load_kernels
from synth.simulate.batched.run import Asked

BATCH = {"cuda": 256, "cpu": 8}
"""Trajectories at once."""
MOST_DRAWN = 4
"""Batches of presses that wait for another pad, at most, before lanes are left empty."""
MIN_PER_SENSOR = 16
"""Waiting trajectories of a sensor that are worth building its renderer for; a clip alone is."""

CORES_A_DRAWER = 2
"""Cores for each process that makes bodies."""

Result = SimulatedTrajectory | Outcome
"""A simulated trajectory, or the record of one whose every instance failed."""
Drawn = tuple[Attempts, Attempt]
Maybe = tuple[Attempts, Attempt | None]
"""A trajectory and its next instance, unless that cannot be built."""


def in_batches(context: JobContext, tasks: Iterator[Task], batch: int | None) -> Iterator[list[Result]]:
    """Simulate tasks; each comes out once, in no particular order, in groups of one sensor's trajectories.

    At most `batch` trajectories run at a time, which on a CPU changes no bit of what comes out. InputError where the
    storage refuses, or for CUDA without cuBLAS or cuSOLVER.
    """
    simulation = _Simulation(context, tasks, batch or BATCH[context.plan.device])
    return by_sensor(context.plan.template, simulation, simulation.open)


class _Simulation:
    """An iterator over (trajectory, its result) as they end; `open` counts those of each sensor that are under way."""

    def __init__(self, context: JobContext, tasks: Iterator[Task], batch: int) -> None:
        self._context, self._tasks, self._batch = context, tasks, batch
        self._pads = Pads(context)
        self._again: list[Attempts] = []
        self._given_up: list[Attempts] = []
        self._drawn: dict[Gel, deque[Drawn]] = {}
        self._firsts = _first_instances(context, self._begun())
        self.open: Counter[int] = Counter()

    def __iter__(self) -> Iterator[tuple[int, Result]]:
        if self._context.plan.device == "cuda":
            load_kernels()
        with closing(self._firsts):
            yield from self._results()

    def _results(self) -> Iterator[tuple[int, Result]]:
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
        if self._again:
            attempts, attempt = _next_instance(self._again.pop())
        elif (first := next(self._firsts, None)) is not None:
            attempts, attempt = first
        else:
            return False
        if attempt is not None:
            self._drawn.setdefault(pad_key(attempt.press), deque()).append((attempts, attempt))
        elif attempts.is_exhausted:
            self._given_up.append(attempts)
        else:
            self._again.append(attempts)
        return True

    def _begun(self) -> Iterator[Attempts]:
        """Trajectories of which nothing is drawn yet, counted as `open`."""
        template, seed = self._context.plan.template, self._context.job.seed
        last: tuple[int, SensorInstance] | None = None
        for task in self._tasks:
            sensor = sensor_of(template, task[0])
            if last is None or last[0] != sensor:
                last = sensor, draw_sensor(template, seed, sensor)
            self.open[sensor] += 1
            yield Attempts(self._context, task, last[1])


def _next_instance(attempts: Attempts) -> Maybe:
    return attempts, attempts.next(retry=False)


def _first_instances(context: JobContext, begun: Iterator[Attempts]) -> Generator[Maybe, None, None]:
    """In any order, by processes where they take long."""
    if _are_slow(context):
        workers = max(1, cores() // CORES_A_DRAWER)
        yield from spread(context, _drawer, begun, workers, number=lambda attempts: attempts.trajectory)
    else:
        yield from map(_next_instance, begun)


def _are_slow(context: JobContext) -> bool:
    plan = context.plan
    bodies = (corner.contact.indenter for corner in plan.template.corners)
    return plan.device == "cuda" and any(isinstance(body, MeshIndenter) for body in bodies)


def _drawer(context: JobContext) -> Maker[Attempts, Maybe]:
    return _next_instance


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
