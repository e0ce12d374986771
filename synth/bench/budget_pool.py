"""Presses spread over worker processes of one thread each; as `synth.pipeline.worker_pool` does for samples."""

import threading
from collections.abc import Generator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from multiprocessing.connection import Connection

from synth.bench.budget_press import Pressed, press
from synth.bench.budget_schedule import Schedule
from synth.bench.budget_study import Job, Study
from synth.errors import InputError
from synth.pipeline.threads import one_thread_each
from synth.pipeline.worker_pool import exit_with_parent, interrupts_blocked


def presses(study: Study, schedule: Schedule, workers: int, machine: str) -> Generator[Pressed, None, None]:
    """What the jobs gave, in the order in which they end.

    Args:
        study: that they belong to.
        schedule: which to begin.
        workers: processes; 1 stays in this one.
        machine: to be noted with each press.

    Raises:
        InputError: a worker process died.
    """
    if workers == 1:
        while job := schedule.begin():
            pressed = press(study, job, machine)
            schedule.end(job)
            yield pressed
        return
    context = get_context("spawn")  # Warp does not survive a fork
    leash, held = context.Pipe(duplex=False)
    with leash, held, ProcessPoolExecutor(workers, context, _begin, (study, machine, leash)) as pool:
        pending: set[Future[Pressed]] = set()
        try:
            while True:
                while len(pending) < workers and (job := schedule.begin()):
                    with interrupts_blocked(), one_thread_each():
                        pending.add(pool.submit(_work, job))
                if not pending:
                    return
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                for future in done:
                    schedule.end(future.result().measurement.job)
                    yield future.result()
        except BrokenProcessPool as error:
            raise InputError(
                "a worker process died (out of memory, or killed); finished presses are kept: "
                "give the same command again to go on, with fewer --workers"
            ) from error
        except BaseException:
            held.close()
            raise


_task: tuple[Study, str] | None = None
"""What a worker process works on, set when it starts."""


def _begin(study: Study, machine: str, leash: Connection) -> None:
    global _task
    threading.Thread(target=exit_with_parent, args=(leash,), daemon=True).start()
    _task = study, machine


def _work(job: Job) -> Pressed:
    if _task is None:
        raise RuntimeError("the worker process was not set up by _begin")
    study, machine = _task
    return press(study, job, machine)
