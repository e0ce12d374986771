"""Several GPUs of one machine, from one command: each makes a shard of the job in a process of its own.

A process sees its GPU alone and takes an equal share of the cores; its own workers inherit both. What it makes is a
shard like any other: a run that was killed is continued on any number of GPUs.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from threading import Thread
from typing import Generic, TypeVar

from synth.errors import InputError
from synth.pipeline.worker_pool import exit_with_parent, interrupts_blocked, main_left_out

Made = TypeVar("Made")
VISIBLE = "CUDA_VISIBLE_DEVICES"
_FREE_CORES = 2
"""Cores that a shard needs at least: its driver's and a worker's."""


@dataclass(frozen=True)
class _Told(Generic[Made]):
    """What a shard's process says: how far it is, at last what it made, or why it stopped."""

    done: int = 0
    asked_for: int = 0
    made: Made | None = None
    stopped: str = ""


def cuda_devices() -> int:
    """Number of GPUs that this process sees."""
    from synth.warp_start import start_warp

    start_warp()
    import warp as wp

    return int(wp.get_cuda_device_count())


def on_devices(
    make: Callable[[int, Callable[[int, int], None]], Made], devices: int, progress: Callable[[int, int], None]
) -> list[Made]:
    """What `make(number, progress)`, which is picklable, returns for each device, run in a process that sees that one.

    `progress` gets the sums of what the processes tell theirs. InputError, once all have ended, where one raised it.
    """
    spawn = get_context("spawn")
    parent_death, parents_end = spawn.Pipe(duplex=False)
    told: dict[Connection, _Told[Made]] = {}
    with ExitStack() as ending, parent_death, parents_end:
        with interrupts_blocked(), main_left_out():
            for number in range(devices):
                answers, childs_end = spawn.Pipe(duplex=False)
                process = spawn.Process(target=_run, args=(make, number, devices, childs_end, parent_death))
                with _only_device(number), childs_end:
                    process.start()
                ending.callback(process.join)
                told[answers] = _Told()
        ending.callback(parents_end.close)  # before the processes are waited for, whatever happened
        open_ends = set(told)
        while open_ends:
            for end in wait(open_ends):
                assert isinstance(end, Connection)
                try:
                    told[end] = end.recv()
                except EOFError:
                    open_ends.remove(end)
            progress(sum(one.done for one in told.values()), sum(one.asked_for for one in told.values()))
    lost = "a GPU's process ended; finished samples are kept: give the same command again to go on"
    made = [one.made for one in told.values() if one.made is not None]
    if len(made) < devices:
        raise InputError(next((one.stopped for one in told.values() if one.stopped), lost))
    return made


@contextmanager
def _only_device(number: int) -> Iterator[None]:
    """Processes started meanwhile see this one of the GPUs that this process sees."""
    before = os.environ.get(VISIBLE)
    os.environ[VISIBLE] = before.split(",")[number] if before else str(number)
    try:
        yield
    finally:
        if before is None:
            del os.environ[VISIBLE]
        else:
            os.environ[VISIBLE] = before


def _run(
    make: Callable[[int, Callable[[int, int], None]], Made],
    number: int,
    devices: int,
    answers: Connection,
    parent_death: Connection,
) -> None:
    """A shard's process."""
    Thread(target=exit_with_parent, args=(parent_death,), daemon=True).start()
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) >= _FREE_CORES * devices:
            share = len(cores) // devices  # neighbours, which share caches
            os.sched_setaffinity(0, cores[number * share : (number + 1) * share])
    try:
        last: _Told[Made] = _Told()

        def progress(done: int, asked_for: int) -> None:
            nonlocal last
            last = _Told(done, asked_for)
            answers.send(last)

        made = make(number, progress)
        answers.send(_Told(last.done, last.asked_for, made))
    except InputError as error:
        answers.send(_Told(stopped=str(error)))
