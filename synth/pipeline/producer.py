"""One trajectory's samples from beginning to end, in one process."""

from collections.abc import Sequence

from synth.errors import InputError
from synth.pipeline.attempts import Attempts
from synth.pipeline.finishing import finish
from synth.pipeline.pads import Pads
from synth.pipeline.records import JobContext, Outcome
from synth.pipeline.render_session import RenderSession
from synth.sampling import draw_sensor, sensor_of
from synth.simulate.batched import simulate_presses
from synth.simulate.solve import simulate_press


class Producer:
    """Makes trajectories' samples; keeps the last sensor's renderer."""

    def __init__(self, context: JobContext) -> None:
        self._context = context
        self._session = RenderSession(context)
        self._pads = Pads(context)

    def produce(self, trajectory: int, wanted: Sequence[int]) -> Outcome:
        """Write the samples of a trajectory that are wanted, since they are not there yet.

        InputError where the storage refuses, or the batched solver lacks something.
        """
        template, seed = self._context.plan.template, self._context.job.seed
        sensor = draw_sensor(template, seed, sensor_of(template, trajectory))
        attempts = Attempts(self._context, (trajectory, tuple(wanted)), sensor)
        while (attempt := attempts.next()) is not None:
            # What is wrong with a shared pad is wrong for all attempts.
            pad = self._pads.of(attempt.press) if self._context.plan.is_batched else None
            try:
                if pad is None:
                    result = simulate_press(attempt.press, attempt.frames)
                else:
                    ((_, result),) = simulate_presses([(attempt.press, attempt.frames)], pad)
            except InputError as error:
                attempts.fail("simulate", str(error))
                continue
            if (simulated := attempts.simulated(attempt, result)) is not None:
                return finish(self._context, self._session.render_frames(simulated))
        return attempts.given_up()
