"""Batched simulation beside rendering beside writing.

    solver's thread -> a few simulated trajectories -> this thread: rendering -> worker processes: flow, noise, files

Simulation and rendering share this process's GPU, each on a stream of its own, and nothing else uses it. Textures are
painted in further threads as soon as their sensor's turn is near. Every queue between two stages has room for a fixed
number of trajectories: whoever is ahead waits, so that memory does not grow with the number of samples. The solver's is
long enough that rendering goes on while the next chunk is drawn. A killed run loses what is in the queues; failed
instances and samples come out the same the next time.
"""

import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from typing import Any, TypeVar

from synth.arrays import Image
from synth.pipeline.batched_simulation import Result, in_batches
from synth.pipeline.finishing import finish
from synth.pipeline.records import JobContext, Outcome, Task
from synth.pipeline.render_session import RenderedTrajectory, RenderSession, paint
from synth.pipeline.worker_pool import Maker, spread
from synth.scene import Sensor

PREFETCHED = 256
"""Simulated trajectories that wait to be rendered, at most: some hundred kilobytes each."""
TEXTURES, TEXTURE_THREADS = 8, 6
"""Most textures, up to 94 MB each, that are being painted or wait to be used; and threads that paint them."""

Rendered = RenderedTrajectory | Outcome
Item = TypeVar("Item")
_END: Any = object()


def outcomes_of_batches(
    context: JobContext, tasks: Iterator[Task], workers: int, batch: int | None
) -> Generator[Outcome, None, None]:
    """Outcomes in the order in which they are ready; tasks are taken in the solver's thread.

    Flow, noise and files are made by worker processes; if `workers` is 1 this process does everything, one thing after
    another. At most `batch` trajectories are simulated at a time; None for what suits the device. InputError where the
    storage refuses, for CUDA without cuBLAS or cuSOLVER, or if worker processes die again and again.
    """
    session, results = RenderSession(context), in_batches(context, tasks, batch)
    if workers == 1:
        for result in results:
            yield result if isinstance(result, Outcome) else finish(context, session.render_frames(*result))
        return
    pairs = context.plan.template.sampling.pairs_per_trajectory

    def number(item: Rendered) -> int:
        return item.given_up[0] // pairs if isinstance(item, Outcome) else item.simulated.number

    with ThreadPoolExecutor(TEXTURE_THREADS) as threads:
        textures = Textures(context, threads)
        try:
            requested = _with_textures(results, textures)
            with prefetched(requested, PREFETCHED) as ready, closing(_rendered(session, ready, textures)) as items:
                yield from spread(context, _finisher, items, workers, number)
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
            textures.release(TEXTURE_THREADS)  # no thread waits for room any more


class Textures:
    """Textures of a job's sensors, painted by the given threads in the order in which they are asked for.

    At most `room` are being painted or wait to be used.
    """

    def __init__(self, context: JobContext, threads: ThreadPoolExecutor, room: int = TEXTURES) -> None:
        self._context, self._threads, self._room = context, threads, threading.Semaphore(room)

    def request(self, number: int, sensor: Sensor) -> "Future[Image]":
        """The texture of a sensor, by its number, begun when there is room; in any thread."""
        return self._threads.submit(self._paint, number, sensor)

    def release(self, count: int = 1) -> None:
        """Makes room for `count` other textures, because requested ones are no longer held; in any thread."""
        self._room.release(count)

    def _paint(self, number: int, sensor: Sensor) -> Image:
        self._room.acquire()
        return paint(self._context, number, sensor)


@contextmanager
def prefetched(items: Iterable[Item], limit: int) -> Iterator[Iterator[Item]]:
    """Take items, in their order, from an iterator that runs in another thread; what it raises is raised here.

    When `limit` items wait to be taken, the other thread waits. On leaving, it stops after its present item.
    """
    source = iter(items)
    thread = ThreadPoolExecutor(1)
    waiting = deque(thread.submit(next, source, _END) for _ in range(limit))

    def in_order() -> Iterator[Item]:
        while (item := waiting.popleft().result()) is not _END:
            waiting.append(thread.submit(next, source, _END))
            yield item

    try:
        yield in_order()
    finally:
        thread.shutdown(cancel_futures=True)


def _with_textures(results: Iterable[Result], textures: Textures) -> Iterator[tuple[Result, Future[Image] | None]]:
    """Results, each with the texture of its sensor where that is another one than the last result's."""
    last: int | None = None
    for result in results:
        if isinstance(result, Outcome):
            yield result, None
            continue
        trajectory, _ = result
        is_new, last = trajectory.sensor != last, trajectory.sensor
        yield result, textures.request(trajectory.sensor, trajectory.scene.sensor) if is_new else None


def _rendered(
    session: RenderSession, ready: Iterable[tuple[Result, Future[Image] | None]], textures: Textures
) -> Generator[Rendered, None, None]:
    """Rendered trajectories, in this thread: Mitsuba has one variant a process and Dr.Jit one stream a thread."""
    for result, texture in ready:
        rendered = result if isinstance(result, Outcome) else session.render_frames(*result, texture)
        if texture is not None:
            textures.release()
        del result, texture  # the texture is the renderer's own now
        yield rendered


def _finisher(context: JobContext) -> Maker[Rendered]:
    """What a worker process does with a rendered trajectory."""
    return lambda item: item if isinstance(item, Outcome) else finish(context, item)
