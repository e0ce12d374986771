"""Batched simulation beside everything else.

    solver's thread -> a few groups of simulated trajectories -> worker processes: rendering, flow, noise, files

A group is of one sensor (`batched_simulation.by_sensor`). Solver and workers share the GPU, where there is one: frames
are so short there that one process could not keep it busy. The queue between the two has room for a fixed number of
groups: the solver waits when it is ahead, so that memory does not grow with the number of samples. It is long enough
that rendering goes on while the next chunk is drawn. A killed run loses what is in the queue; failed instances and
samples come out the same the next time.
"""

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from synth.pipeline.batched_simulation import Result, in_batches
from synth.pipeline.finishing import finish, load_kernels
from synth.pipeline.records import JobContext, Outcome, Task
from synth.pipeline.render_session import RenderSession
from synth.pipeline.worker_pool import Maker, render_on_one_core, spread

PREFETCHED = 256
"""Groups of simulated trajectories that wait to be rendered, at most: some hundred kilobytes a trajectory."""

Item = TypeVar("Item")
_END: Any = object()


def outcomes_of_batches(
    context: JobContext, tasks: Iterator[Task], workers: int, batch: int | None
) -> Generator[Outcome, None, None]:
    """Outcomes in the order in which they are ready; tasks are taken in the solver's thread.

    Pictures, flow and files are made by worker processes; if `workers` is 1 this process does everything, one thing
    after another. At most `batch` trajectories are simulated at a time; None for what suits the device. InputError
    where the storage refuses, for CUDA without cuBLAS or cuSOLVER, or if worker processes die again and again.
    """
    groups = in_batches(context, tasks, batch)
    if workers == 1:
        yield from map(_finisher(context, RenderSession(context)), groups)
        return
    per_trajectory = context.plan.template.sampling.samples_per_trajectory

    def number(group: list[Result]) -> int:
        first = group[0]
        return first.given_up[0] // per_trajectory if isinstance(first, Outcome) else first.number

    with prefetched(groups, PREFETCHED) as ready:
        yield from spread(context, _finisher_on_one_core, ready, workers, number)


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


def _finisher_on_one_core(context: JobContext) -> Maker[list[Result], Outcome]:
    """What a worker process does with a group; on a GPU kernels are compiled while the first group is simulated."""
    render_on_one_core(context.plan)
    session = RenderSession(context)
    if context.plan.variant.is_on_gpu:
        session.warm_up()
        load_kernels(context.plan.device)
    return _finisher(context, session)


def _finisher(context: JobContext, session: RenderSession) -> Maker[list[Result], Outcome]:
    def made(result: Result) -> Outcome:
        return result if isinstance(result, Outcome) else finish(context, session.render_frames(result))

    return lambda group: Outcome.of_all(map(made, group))
