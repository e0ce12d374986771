"""One trajectory's samples from beginning to end, in one process."""

import time
from collections.abc import Sequence
from concurrent.futures import Future

from synth.arrays import Image
from synth.errors import InputError
from synth.pipeline.attempts import Drawn, Draws, Solved
from synth.pipeline.batched_simulation import Pads, simulated_alone
from synth.pipeline.finishing import Developed, finish
from synth.pipeline.records import Outcome, Workplace
from synth.pipeline.render_session import Studio
from synth.scene import MeshIndenter
from synth.scene.sampling import draw_sensor, sensor_of
from synth.simulate import Trajectory, simulate
from synth.simulate.batched.pad import Pad
from synth.simulate.indenter import object_radius
from synth.simulate.shared import Accuracy


class Producer:
    """Makes trajectories' samples; keeps the last sensor's renderer."""

    def __init__(self, workplace: Workplace) -> None:
        """Nothing is loaded before the first trajectory."""
        self._place = workplace
        self._studio = Studio(workplace)
        self._pads = Pads(workplace)

    def produce(self, trajectory: int, wanted: Sequence[int]) -> Outcome:
        """Write the wanted samples of a trajectory.

        Args:
            trajectory: its number.
            wanted: indices of the samples that are not there yet.

        Raises:
            InputError: the storage refuses, or the batched solver lacks something.
        """
        template, seed = self._place.template, self._place.job.seed
        sensor = draw_sensor(template, seed, sensor_of(template, trajectory))
        draws = Draws(self._place, (trajectory, tuple(wanted)), sensor)
        while (drawn := draws.next()) is not None:
            pad = self._pads.of(drawn) if self._place.is_batched else None  # what is wrong here is wrong for all draws
            try:
                result = self._simulated(drawn, pad)
            except InputError as error:
                draws.fail("simulate", str(error))
                continue
            if draws.accepts(result):
                return finish(self._place, develop(self._studio, Solved.of(draws, drawn, result)))
        return draws.given_up()

    def _simulated(self, drawn: Drawn, pad: Pad | None) -> Trajectory:
        if pad is not None:
            return simulated_alone(self._place, drawn, pad)
        return simulate(drawn.scene, drawn.mesh, self._place.template.source.parent, frames=drawn.frames)


def develop(studio: Studio, solved: Solved, texture: Future[Image] | None = None) -> Developed:
    """Render the frames of a simulated trajectory that its wanted samples show.

    Args:
        studio: where.
        solved: the trajectory.
        texture: of its sensor, where it is being painted already.
    """
    started = time.perf_counter()
    drawn = solved.drawn
    surface = studio.surface_of(drawn.scene, solved.space)
    displacements = {frame: state.displacement for frame, state in solved.states.items()}
    frames = studio.frames(drawn.scene, drawn.trajectory, drawn.sensor, surface, displacements, texture)
    count, indenter = len(drawn.pairs), drawn.scene.contact.indenter
    rounded = object_radius(indenter, solved.space.resolution_mm) if isinstance(indenter, MeshIndenter) else None
    return Developed(
        trajectory=drawn.trajectory,
        scene=drawn.scene,
        surface=surface,
        pairs=drawn.pairs,
        states=solved.states,
        frames=frames,
        mesh=drawn.mesh.hash,
        element=solved.space.element.name,
        edge_radius_mm=rounded,
        accuracy=None if drawn.resolution is None else Accuracy.of(drawn.resolution),
        failures=solved.failures,
        seconds={"simulate": solved.seconds / count, "render": (time.perf_counter() - started) / count},
    )
