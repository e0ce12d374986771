"""Tasks spread over worker processes of this machine.

Workers live and die with the driver: each holds the reading end of a pipe that the driver alone can write to, and
leaves when it closes, which the system does when the driver is killed. Ctrl-C reaches all processes of a terminal at
once; the workers are started with it blocked, and the driver, which gets it, closes the pipe.

A worker that dies (killed, out of memory) takes the pool with it. What was under way goes to a new pool: a task may be
done twice, with the same result.
"""

import contextlib
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection

from synth.errors import InputError
from synth.produce import Outcome, Producer, Task, Workplace

MAX_DEATHS = 3
"""Pools that may break one after the other without a finished task between them."""


def outcomes_of_processes(place: Workplace, tasks: Iterator[Task], workers: int) -> Generator[Outcome, None, None]:
    """Outcomes in the order in which they are ready; at most two tasks per worker are waiting at any time.

    Raises:
        InputError: the storage refuses, or worker processes die again and again.
    """
    place = replace(place, threads=max(1, (os.cpu_count() or 1) // workers))
    again: deque[Task] = deque()
    deaths = 0
    while True:
        try:
            for outcome in _outcomes_of_pool(place, tasks, again, workers):
                deaths = 0
                yield outcome
            return
        except BrokenProcessPool as error:
            deaths += 1
            numbers = ", ".join(str(trajectory) for trajectory, _ in sorted(again)[:8])
            if deaths == MAX_DEATHS:
                raise InputError(
                    f"worker processes died {deaths} times in a row (out of memory, or killed), at trajectories "
                    f"{numbers}; finished samples are kept: give the same command again to go on, "
                    "with fewer --workers if memory is short"
                ) from error
            print(f"synth: a worker process died; trajectories {numbers} are made again", file=sys.stderr, flush=True)


def _outcomes_of_pool(
    place: Workplace, tasks: Iterator[Task], again: deque[Task], workers: int
) -> Generator[Outcome, None, None]:
    """Outcomes of `again`, then of `tasks`; when the pool breaks, `again` holds what it had not finished."""
    context = get_context("spawn")  # Dr.Jit and Warp do not survive a fork
    leash, held = context.Pipe(duplex=False)
    under_way: dict[Future[Outcome], Task] = {}
    with leash, held, ProcessPoolExecutor(workers, context, _begin, (place, leash)) as pool:
        try:
            while True:
                while len(under_way) < 2 * workers and (task := again[0] if again else next(tasks, None)) is not None:
                    if not again:
                        again.append(task)  # not lost should the pool be broken already
                    with interrupts_blocked():
                        under_way[pool.submit(_work, *task)] = task
                    again.popleft()
                if not under_way:
                    return
                done, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for future in sorted(done, key=lambda future: future.exception() is not None):
                    outcome = future.result()
                    del under_way[future]
                    yield outcome
        except BrokenProcessPool:
            again.extend(under_way.values())
            raise
        except BaseException:
            held.close()
            raise


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Ctrl-C waits; processes started meanwhile never get it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def leave_with_driver(leash: Connection) -> None:
    """End this process, whatever it is doing, when the driver lets go of the pipe; unfinished samples stay hidden."""
    with contextlib.suppress(EOFError, OSError):
        leash.recv_bytes()
    os._exit(1)


_producer: Producer | None = None
"""A worker process's producer, set when the process starts."""


def _begin(place: Workplace, leash: Connection) -> None:
    global _producer
    threading.Thread(target=leave_with_driver, args=(leash,), daemon=True).start()
    _producer = Producer(place)


def _work(trajectory: int, wanted: tuple[int, ...]) -> Outcome:
    if _producer is None:
        raise RuntimeError("the worker process was not set up by _begin")
    return _producer.produce(trajectory, wanted)
