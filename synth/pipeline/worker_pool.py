"""Items of work spread over worker processes.

A worker takes one core: one thread in every library. As many workers as a job has cores fill them, however many the
machine has.

Workers live and die with the driver: each holds the reading end of a parent-death pipe, which the driver alone can
write to, and leaves when it closes, which the system does when the driver is killed. Ctrl-C reaches all processes of a
terminal at once; the workers are started with it blocked, and the driver, which gets it, closes the pipe.

Workers do not import the user's program, as Python has it: it would begin the job anew where no
`if __name__ == "__main__":` guards it, and cannot be found where it comes from standard input.

A worker that dies (killed, out of memory) takes the pool with it. What was under way goes to a new pool: an item may be
done twice, with the same result.

Beside the libraries here nothing starts threads that compute: Pardiso always has one (`synth.simulate.linear`), and so
have Warp's kernels on a CPU.
"""

import contextlib
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Lock
from types import ModuleType
from typing import Any, TypeAlias, TypeVar

from synth.errors import InputError
from synth.pipeline.producer import Producer
from synth.pipeline.records import JobContext, Outcome, Task
from synth.planning import Plan

Item = TypeVar("Item")
Made = TypeVar("Made")
Maker: TypeAlias = Callable[[Item], Made]
"""What a worker does with an item."""

MAX_DEATHS = 3
"""Pools that may break one after the other without a finished task between them."""


def outcomes_of_processes(context: JobContext, tasks: Iterator[Task], workers: int) -> Generator[Outcome, None, None]:
    """Outcomes of whole trajectories, each made by one worker on one core; see `spread`."""
    yield from spread(context, _trajectory_maker, tasks, workers, number=lambda task: task[0])


def spread(
    context: JobContext,
    make: Callable[[JobContext], Maker[Item, Made]],
    items: Iterator[Item],
    workers: int,
    number: Callable[[Item], int],
) -> Generator[Made, None, None]:
    """What is made of items, in the order in which it is ready; at most two items per worker are under way at a time.

    `make` gives, in each worker process, what does it, and keeps a renderer to one core; like the items it is
    picklable. `number` gives the trajectory of an item, for messages. InputError where the storage refuses,
    or worker processes die again and again.
    """
    again: deque[Item] = deque()
    deaths = 0
    while True:
        try:
            for outcome in _outcomes_of_pool(context, make, items, again, workers):
                deaths = 0
                yield outcome
            return
        except BrokenProcessPool as error:
            deaths += 1
            numbers = ", ".join(map(str, sorted(map(number, again))[:8]))
            if deaths == MAX_DEATHS:
                raise InputError(
                    f"worker processes died {deaths} times in a row (out of memory, or killed), at trajectories "
                    f"{numbers}; finished samples are kept: give the same command again to go on, "
                    "with fewer --workers if memory is short"
                ) from error
            print(f"synth: a worker process died; trajectories {numbers} are made again", file=sys.stderr, flush=True)


def _outcomes_of_pool(
    context: JobContext,
    make: Callable[[JobContext], Maker[Item, Made]],
    items: Iterator[Item],
    again: deque[Item],
    workers: int,
) -> Generator[Made, None, None]:
    """Outcomes of `again`, then of `items`; when the pool breaks, `again` holds what it had not finished."""
    spawn = get_context("spawn")  # Dr.Jit and Warp do not survive a fork
    parent_death, parents_end = spawn.Pipe(duplex=False)
    under_way: dict[Future[Made], Item] = {}
    pool = ProcessPoolExecutor(workers, spawn, _begin, (context, make, parent_death, spawn.Lock()))
    with parent_death, parents_end, pool:
        try:
            # All begin at once: the first items may be long in coming. Items find out if the pool is broken.
            with _starting(), contextlib.suppress(OSError, ValueError, BrokenProcessPool):
                for _ in range(workers):
                    pool.submit(int)
            while True:
                room = len(under_way) < 2 * workers
                if room and not again:
                    again.extend(islice(items, 1))
                begins = room and bool(again)
                if begins:
                    item = again[0]  # not lost should the pool be broken already
                    with _starting():
                        under_way[_submit(pool, item)] = item
                    again.popleft()
                if not under_way:
                    return
                # Items may take long to come: what is ready meanwhile does not wait for the last of them.
                done, _ = wait(under_way, 0 if begins else None, FIRST_COMPLETED)
                for future in sorted(done, key=lambda future: future.exception() is not None):
                    outcome = future.result()
                    del under_way[future]
                    yield outcome
        except BrokenProcessPool:
            again.extend(under_way.values())
            raise
        except BaseException:
            parents_end.close()
            raise


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Workers are started meanwhile, by one thread at a time: the lock of main_left_out guards the environment, too."""
    with interrupts_blocked(), main_left_out(), one_thread_each():
        yield


def _submit(pool: ProcessPoolExecutor, item: Any) -> Future[Any]:
    try:
        return pool.submit(_work, item)
    except (OSError, ValueError) as error:  # "handle is closed": the pool broke while this call started a worker
        raise BrokenProcessPool from error


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Ctrl-C waits; processes started meanwhile never get it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_main = threading.RLock()
"""Who starts processes at the time: a job's main thread, or its solver's."""


@contextlib.contextmanager
def main_left_out() -> Iterator[None]:
    """Processes started meanwhile do not import this process's main module."""
    with _main:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


def exit_with_parent(parent_death: Connection) -> None:
    """End this process, whatever it is doing, when the driver lets go of the pipe; unfinished samples stay hidden."""
    with contextlib.suppress(EOFError, OSError):
        parent_death.recv_bytes()
    os._exit(1)


_maker: Maker[Any, Any]
"""What a worker process does, set when the process starts."""


def _begin(
    context: JobContext, make: Callable[[JobContext], Maker[Any, Any]], parent_death: Connection, first: Lock
) -> None:
    global _maker
    threading.Thread(target=exit_with_parent, args=(parent_death,), daemon=True).start()
    if first.acquire(block=False):
        try:
            _maker = make(context)
        finally:
            first.release()
        return
    with first:  # what the first worker has compiled is then found on disk
        pass
    _maker = make(context)


def _work(item: Any) -> Any:
    return _maker(item)


def _trajectory_maker(context: JobContext) -> Maker[Task, Outcome]:
    render_on_one_core(context.plan)
    producer = Producer(context)
    return lambda task: producer.produce(*task)


THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Read by linear algebra libraries and OpenCV when they are loaded."""


def cores() -> int:
    """Number of processor cores that this process may use; on a cluster fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started meanwhile use one thread in every library but the renderer; what this process has loaded keeps
    its own.
    """
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def render_on_one_core(plan: Plan) -> None:
    """Have this process, a worker, render with one thread; Mitsuba's scalar code has its threads from Dr.Jit, too."""
    if not plan.template.outputs.images:
        return
    plan.variant.load()
    import drjit

    drjit.set_thread_count(1)
