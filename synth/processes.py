"""Tasks spread over worker processes of this machine.

Workers live and die with the driver: each holds the reading end of a pipe that the driver alone can write to, and
leaves when it closes, which the system does when the driver is killed. Ctrl-C reaches all processes of a terminal at
once; the workers are started with it blocked, and the driver, which gets it, closes the pipe.
"""

import contextlib
import os
import signal
import threading
from collections.abc import Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from multiprocessing import get_context
from multiprocessing.connection import Connection

from synth.errors import InputError
from synth.produce import Outcome, Producer, Task, Workplace


def outcomes_of_processes(place: Workplace, tasks: Iterator[Task], workers: int) -> Generator[Outcome, None, None]:
    """Outcomes in the order in which they are ready; at most two tasks per worker are waiting at any time.

    Raises:
        InputError: the storage refuses, or a worker process died.
    """
    context = get_context("spawn")  # Dr.Jit and Warp do not survive a fork
    leash, held = context.Pipe(duplex=False)
    place = replace(place, threads=max(1, (os.cpu_count() or 1) // workers))
    with leash, held, ProcessPoolExecutor(workers, context, _begin, (place, leash)) as pool:
        pending: set[Future[Outcome]] = set()
        try:
            for task in tasks:
                with _interrupts_blocked():
                    pending.add(pool.submit(_work, *task))
                while len(pending) >= 2 * workers:
                    done, pending = wait(pending, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            while pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        except BrokenProcessPool as error:
            raise InputError(
                "a worker process died (out of memory, or killed); finished samples are kept: "
                "give the same command again to go on"
            ) from error
        except BaseException:
            held.close()
            raise


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Ctrl-C waits; processes started meanwhile never get it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_producer: Producer | None = None
"""A worker process's producer, set when the process starts."""


def _begin(place: Workplace, leash: Connection) -> None:
    global _producer
    threading.Thread(target=_leave_with_driver, args=(leash,), daemon=True).start()
    _producer = Producer(place)


def _leave_with_driver(leash: Connection) -> None:
    """End this process, whatever it is doing, when the driver lets go of the pipe; unfinished samples stay hidden."""
    with contextlib.suppress(EOFError, OSError):
        leash.recv_bytes()
    os._exit(1)


def _work(trajectory: int, wanted: tuple[int, ...]) -> Outcome:
    if _producer is None:
        raise RuntimeError("the worker process was not set up by _begin")
    return _producer.produce(trajectory, wanted)
