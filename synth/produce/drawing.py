"""The draws of one trajectory, one after the other, until one of them can be used."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from synth.dataset.meshes import mesh_folder
from synth.errors import InputError
from synth.mesh import PadMesh
from synth.produce.records import FaceState, Failure, Outcome, Task, Workplace
from synth.sampling import MAX_DRAWS, Pair, SensorDraw, draw, pairs_of
from synth.scene import Scene
from synth.simulate import Trajectory
from synth.simulate.resolution import Resolution, resolve
from synth.simulate.shared import shared_mesh
from synth.simulate.space import Space


@dataclass(frozen=True, eq=False)
class Drawn:
    """A draw to be simulated.

    Attributes:
        trajectory: its number.
        scene: fully drawn.
        mesh: to be simulated on.
        resolution: of that mesh for this draw; None where all draws share it: see `synth.simulate.shared`.
        pairs: the samples that are wanted.
        frames: numbers of the states that any sample of the trajectory shows, wanted or not: a state's bits must not
            depend on which samples are still to be made.
    """

    trajectory: int
    scene: Scene
    mesh: PadMesh
    resolution: Resolution | None
    pairs: tuple[Pair, ...]
    frames: frozenset[int]

    @property
    def sensor(self) -> int:
        """Number of its sensor."""
        return self.pairs[0].sensor


class Draws:
    """See the module's docstring; keeps the record of draws that failed."""

    def __init__(self, place: Workplace, task: Task, sensor: SensorDraw) -> None:
        """Begin with the first draw; `sensor` is the draw of the trajectory's sensor."""
        self.trajectory, self.wanted = task
        self._place, self._sensor, self._attempt = place, sensor, 0
        self._first = self.trajectory * place.template.corners[0].sampling.pairs_per_trajectory
        self.failures: list[Failure] = []
        for reason in sensor.rejected:
            self.fail("sensor", reason)

    def next(self) -> Drawn | None:
        """The next draw that keeps the schema and can be meshed; None when there are no more."""
        template, seed = self._place.template, self._place.job.seed
        while self._sensor.content is not None and self._attempt < MAX_DRAWS:
            self._attempt += 1
            stage = "draw"
            try:
                scene = draw(template, seed, self.trajectory, self._attempt - 1, self._sensor)
                stage = "simulate"
                mesh, resolution = self._meshed(scene)
                every = pairs_of(template, seed, self.trajectory, scene.motion.steps)
            except InputError as error:
                self.fail(stage, str(error))
                continue
            pairs = tuple(pair for pair in every if pair.index in self.wanted)
            frames = frozenset(frame for pair in every for frame in pair.frames)
            return Drawn(self.trajectory, scene, mesh, resolution, pairs, frames)
        return None

    def accepts(self, result: Trajectory) -> bool:
        """Whether a draw's trajectory can be used; if not, that is put on record."""
        if result.status == "complete":
            return True
        self.failures.append(
            Failure(self._first, len(self.failures), "simulate", result.reason, result.states[-1].summary())
        )
        return False

    def fail(self, stage: str, reason: str) -> None:
        """Put a draw on record that did not get as far as a simulation."""
        self.failures.append(Failure(self._first, len(self.failures), stage, reason, None))

    def given_up(self) -> Outcome:
        """What is reported when no draw is left."""
        return Outcome((), tuple(self.failures), tuple(self.wanted))

    def _meshed(self, scene: Scene) -> tuple[PadMesh, Resolution | None]:
        place = self._place
        folders: Sequence[Path] | None = (mesh_folder(place.out), place.cache) if place.needs_meshes else None
        if place.is_batched:
            return shared_mesh(scene.sensor.gel, scene.numerics, folders), None
        resolution = resolve(scene, place.template.source.parent, folders)
        return resolution.mesh, resolution


@dataclass(frozen=True, eq=False)
class Solved:
    """A simulated draw, less what no sample shows.

    Attributes:
        drawn: the draw.
        states: by number, those that the wanted samples show.
        space: where their numbers are.
        failures: draws that failed before.
        seconds: of the simulation.
    """

    drawn: Drawn
    states: dict[int, FaceState]
    space: Space
    failures: tuple[Failure, ...]
    seconds: float

    @staticmethod
    def of(draws: Draws, drawn: Drawn, result: Trajectory) -> "Solved":
        """From a complete trajectory."""
        shown = sorted({frame for pair in drawn.pairs for frame in pair.frames})
        states = {frame: FaceState.of(result.states[frame], result.space) for frame in shown}
        return Solved(drawn, states, result.space, tuple(draws.failures), result.seconds)
