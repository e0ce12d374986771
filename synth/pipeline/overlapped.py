"""Batched simulation beside rendering beside writing.

    solver's thread -> a few simulated trajectories -> this thread: rendering -> worker processes: flow, noise, files

Simulation and rendering share this process's GPU, each on a stream of its own, and nothing else uses it. Textures are
painted in further threads as soon as their sensor's turn is near. Every line between two stages has room for a fixed
number of trajectories: whoever is ahead waits, so that memory does not grow with the number of samples. The solver's is
long enough that rendering goes on while the next chunk is drawn. A killed run loses what is in the lines; failed draws
and samples come out the same the next time.
"""

from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial

from synth.arrays import Image
from synth.pipeline.batched_simulation import Result, in_batches
from synth.pipeline.finishing import Developed, finish
from synth.pipeline.prefetch import ahead
from synth.pipeline.producer import develop
from synth.pipeline.records import Outcome, Task, Workplace
from synth.pipeline.render_session import Studio
from synth.pipeline.textures import Textures
from synth.pipeline.worker_pool import Maker, spread

AHEAD = 256
"""Simulated trajectories that wait to be rendered, at most: some hundred kilobytes each."""
PAINTERS = 6
"""Threads that paint textures."""

Painted = tuple[Result, Future[Image] | None]
"""A result, and the texture of its sensor where that is another one than the last result's."""


def outcomes_of_batches(
    place: Workplace, tasks: Iterator[Task], workers: int, batch: int | None
) -> Generator[Outcome, None, None]:
    """Outcomes in the order in which they are ready.

    Args:
        place: of the job.
        tasks: to do; they are taken in the solver's thread.
        workers: processes for flow, noise and files; 1: this one does everything, one thing after another.
        batch: most trajectories simulated at a time; None for what suits the device.

    Raises:
        InputError: the storage refuses, CUDA without cuBLAS or cuSOLVER, or worker processes die again and again.
    """
    studio, results = Studio(place), in_batches(place, tasks, batch)
    if workers == 1:
        for result in results:
            yield result if isinstance(result, Outcome) else finish(place, develop(studio, result))
        return
    pairs = place.template.corners[0].sampling.pairs_per_trajectory

    def number(item: Developed | Outcome) -> int:
        return item.trajectory if isinstance(item, Developed) else item.given_up[0] // pairs

    with ThreadPoolExecutor(PAINTERS) as painters:
        textures = Textures(place, painters)
        try:
            painted = _painted(results, textures)
            with ahead(painted, AHEAD) as ready, closing(_developed(studio, ready, textures)) as items:
                yield from spread(place, _finisher, items, workers, number)
        finally:
            painters.shutdown(wait=False, cancel_futures=True)


def _painted(results: Iterable[Result], textures: Textures) -> Iterator[Painted]:
    """Results, with their sensors' textures on the way."""
    last: int | None = None
    for result in results:
        if isinstance(result, Outcome):
            yield result, None
            continue
        drawn = result.drawn
        new, last = drawn.sensor != last, drawn.sensor
        yield result, textures.ask(drawn.sensor, drawn.scene.sensor) if new else None


def _developed(
    studio: Studio, ready: Iterable[Painted], textures: Textures
) -> Generator[Developed | Outcome, None, None]:
    """Rendered, in this thread: Mitsuba has one variant a process and Dr.Jit one stream a thread."""
    for result, texture in ready:
        developed = result if isinstance(result, Outcome) else develop(studio, result, texture)
        if texture is not None:
            textures.used()
        del result, texture  # the texture is the renderer's own now
        yield developed


def _finisher(place: Workplace) -> Maker[Developed | Outcome]:
    """In a worker process."""
    return partial(_finished, place)


def _finished(place: Workplace, item: Developed | Outcome) -> Outcome:
    return item if isinstance(item, Outcome) else finish(place, item)
