"""Trajectories simulated many at once.

Tasks are taken some chunks ahead, drawn, sorted by their pads, and run through the slots of `synth.simulate.batched`;
a draw that fails is followed by its trajectory's next one in the next chunk. What a trajectory comes out as does not
depend on which others ran beside it.

The trajectories of one sensor are handed on one after the other, whenever they end: a sensor's renderer is worth as
much as some ten frames. Those that wait for one of their sensor's are a few hundred kilobytes each.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

from synth.errors import InputError
from synth.pipeline.attempts import Drawn, Draws, Solved
from synth.pipeline.records import Outcome, Task, Workplace
from synth.scene import Gel
from synth.scene.sampling import SensorDraw, draw_sensor, sensor_of
from synth.scene.template import Template
from synth.simulate import Trajectory
from synth.simulate.batched.jobs import Job
from synth.simulate.batched.many import job_of, run_jobs
from synth.simulate.batched.pad import Pad, prepare

BATCH = {True: 256, False: 8}
"""Trajectories at once, with a GPU and without."""
CHUNK = 4
"""Trajectories of a chunk in batches: its last ones run beside empty slots. The first chunk is one batch: nothing
can be rendered while it is drawn."""

ENOUGH = 16
"""Trajectories that are worth a change of the sensor."""

Result = Solved | Outcome
"""A simulated trajectory, or the record of one whose every draw failed."""


class Pads:
    """The pad that was used last: mesh, tables and preconditioner, which take seconds to prepare."""

    def __init__(self, place: Workplace) -> None:
        """Nothing is prepared before the first draw."""
        self._place = place
        self._kept: tuple[Gel, Pad] | None = None

    def of(self, drawn: Drawn) -> Pad:
        """The pad of a draw.

        Raises:
            InputError: a mesh that no element can be built on, or CUDA without cuBLAS or cuSOLVER.
        """
        key = pad_key(drawn)
        if self._kept is None or self._kept[0] != key:
            self._kept = None  # gives its memory back first
            self._kept = key, prepare(drawn.scene, drawn.mesh, "cuda" if self._place.has_gpu else "cpu")
        return self._kept[1]


def simulated_alone(place: Workplace, drawn: Drawn, pad: Pad) -> Trajectory:
    """A batch of one draw.

    Raises:
        InputError: the indenter cannot be built.
    """
    job = job_of(drawn.scene, pad, place.template.source.parent)
    ((_, result),) = run_jobs([job], pad, drawn.scene.numerics, [drawn.frames], 1)
    return result


def pad_key(drawn: Drawn) -> Gel:
    """What draws that may run together have in common, and with it the mesh. Without layers stiffness only scales."""
    gel = drawn.scene.sensor.gel
    return gel if gel.layers else gel.model_copy(update={"youngs_modulus_kpa": 1.0})


def in_batches(place: Workplace, tasks: Iterator[Task], batch: int | None = None) -> Iterator[Result]:
    """Simulate tasks; each comes out once, in no particular order but with a sensor's trajectories together.

    Args:
        place: of the job.
        tasks: to do, in the order of their trajectories.
        batch: most trajectories at a time; changes no bit of what comes out.

    Raises:
        InputError: the storage refuses, or CUDA without cuBLAS or cuSOLVER.
    """
    size = batch or BATCH[place.has_gpu]
    solving = _Solving(place, tasks, size, CHUNK * size)
    return by_sensor(place.template, solving, solving.open)


@dataclass(eq=False)
class _Solving:
    """An iterator over (trajectory, its result) as they end; `open` counts those of each sensor that are under way."""

    place: Workplace
    tasks: Iterator[Task]
    batch: int
    chunk: int

    def __post_init__(self) -> None:
        self.open: Counter[int] = Counter()
        self._pads = Pads(self.place)
        self._sensor: tuple[int, SensorDraw] | None = None

    def __iter__(self) -> Iterator[tuple[int, Result]]:
        again: list[Draws] = []
        most = self.batch
        while chunk := [*again, *self._begun(most - len(again))]:
            again, most = [], self.chunk
            ready: dict[Gel, list[tuple[Draws, Drawn]]] = {}
            for draws in chunk:
                drawn = draws.next()
                if drawn is None:
                    yield draws.trajectory, draws.given_up()
                else:
                    ready.setdefault(pad_key(drawn), []).append((draws, drawn))
            for members in ready.values():
                for draws, drawn, result in self._run(members):
                    if result is not None and draws.accepts(result):
                        yield draws.trajectory, Solved.of(draws, drawn, result)
                    else:
                        again.append(draws)

    def _begun(self, most: int) -> list[Draws]:
        """New trajectories."""
        begun = []
        for task in islice(self.tasks, most):
            sensor = sensor_of(self.place.template, task[0])
            if self._sensor is None or self._sensor[0] != sensor:
                self._sensor = sensor, draw_sensor(self.place.template, self.place.job.seed, sensor)
            self.open[sensor] += 1
            begun.append(Draws(self.place, task, self._sensor[1]))
        return begun

    def _run(self, members: list[tuple[Draws, Drawn]]) -> Iterator[tuple[Draws, Drawn, Trajectory | None]]:
        """Trajectories of one pad as they end; None where the indenter cannot be built."""
        pad, folder = self._pads.of(members[0][1]), self.place.template.source.parent
        jobs: list[Job] = []
        built: list[tuple[Draws, Drawn]] = []
        for draws, drawn in members:
            try:
                jobs.append(job_of(drawn.scene, pad, folder))
            except InputError as error:
                draws.fail("simulate", str(error))
                yield draws, drawn, None
            else:
                built.append((draws, drawn))
        frames = [drawn.frames for _, drawn in built]
        for number, result in run_jobs(jobs, pad, members[0][1].scene.numerics, frames, self.batch):
            yield *built[number], result


def by_sensor(template: Template, ended: Iterable[tuple[int, Result]], open: Counter[int]) -> Iterator[Result]:
    """Results of one sensor together: at once after one of the same, else when enough or all of them are there.

    Args:
        template: the scene.
        ended: trajectories and their results as they end.
        open: how many of each sensor are still to come; is counted down.
    """
    waiting: dict[int, list[Result]] = {}
    present: int | None = None
    for trajectory, result in ended:
        sensor = sensor_of(template, trajectory)
        open[sensor] -= 1
        mine = waiting.setdefault(sensor, [])
        mine.append(result)
        if sensor == present or len(mine) >= ENOUGH or open[sensor] == 0:
            present = sensor
            yield from waiting.pop(sensor)
