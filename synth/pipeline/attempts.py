"""The random instances of one trajectory, one after the other, until one of them can be used.

An object whose press does not complete is pressed again, with rounder edges or a stiffer contact, before another
instance is drawn.
"""

from dataclasses import dataclass, replace
from typing import Any

from synth.dataset.manifest import Failure
from synth.errors import InputError
from synth.pipeline.records import JobContext, Outcome, SimulatedTrajectory, Task
from synth.press.press import Press, blunter
from synth.sampling import MAX_DRAWS, SampleFrames, SensorInstance, draw, samples_of
from synth.scene import Scene
from synth.simulate import Trajectory


@dataclass(frozen=True, eq=False)
class Attempt:
    """One instance, to be simulated: its press, and the samples that are wanted of it.

    `frames` are the states that any sample of the trajectory shows, wanted or not: a state's bits must not depend on
    which samples are still to be made. `again` says that the object was pressed before, by the same instance.
    """

    press: Press
    samples: tuple[SampleFrames, ...]
    frames: frozenset[int]
    again: bool


class Attempts:
    """See the module's docstring; keeps the record of instances that failed."""

    def __init__(self, context: JobContext, task: Task, sensor: SensorInstance) -> None:
        """Begin with the first instance; `sensor` is that of the trajectory."""
        self.trajectory, self.wanted = task
        self._context, self._sensor, self._count = context, sensor, 0
        self._first = self.trajectory * context.plan.template.sampling.samples_per_trajectory
        self._waiting: list[Scene] = []
        self.failures: list[Failure] = []
        for reason in sensor.rejected:
            self.fail("sensor", reason)

    @property
    def is_exhausted(self) -> bool:
        return self._sensor.content is None or self._count >= MAX_DRAWS

    def next(self, retry: bool = True) -> Attempt | None:
        """The next instance that keeps the schema and whose mesh and body can be built; None when there are no more.

        Without `retry` also None after an instance whose mesh or body cannot be built.
        """
        plan, seed = self._context.plan, self._context.job.seed
        while not self.is_exhausted:
            self._count += 1
            stage, again = "draw", bool(self._waiting)
            try:
                if not again:
                    self._waiting = [draw(plan.template, seed, self.trajectory, self._count - 1, self._sensor)]
                scene, stage = self._waiting.pop(0), "simulate"
                press = plan.mesh.press(scene, plan.template.folder, self._context.mesh_folders)
            except InputError as error:
                self.fail(stage, str(error))
                if stage == "simulate" and not retry:
                    return None
                continue
            every = samples_of(plan.template, seed, self.trajectory, scene.motion.steps)
            samples = tuple(sample for sample in every if sample.index in self.wanted)
            return Attempt(press, samples, frozenset(frame for one in every for frame in one.frames), again)
        return None

    def simulated(self, attempt: Attempt, result: Trajectory) -> SimulatedTrajectory | None:
        """What is handed on of an instance's trajectory; None if it cannot be used, which is put on record."""
        if result.status != "complete":
            self.fail("simulate", result.reason, result.states[-1].summary())
            if not attempt.again:
                self._waiting += blunter(attempt.press)
            return None
        press, space, states = attempt.press, result.space, result.states
        shown = sorted({frame for sample in attempt.samples for frame in sample.frames})
        return SimulatedTrajectory(
            self.trajectory,
            press.scene,
            attempt.samples,
            {n: replace(states[n], displacement=states[n].displacement[space.surface_nodes]) for n in shown},
            {"mesh": press.mesh.hash, "element": space.element.name},
            space.surface,
            press.path,
            self._context.plan.mesh.lost_detail(press.scene, press.path.body, press.accuracy),
            press.accuracy,
            tuple(self.failures),
            result.seconds,
        )

    def fail(self, stage: str, reason: str, last_good_state: dict[str, Any] | None = None) -> None:
        self.failures.append(Failure(self._first, len(self.failures), stage, reason, last_good_state))

    def given_up(self) -> Outcome:
        """What is reported when no instance is left."""
        return Outcome((), tuple(self.failures), tuple(self.wanted))
