"""Processes that load data: how they begin, and that they end when their run says so, not by the signals that ask it
to stop.

Ctrl-C and SIGTERM reach every process of a group or a job, and the run wants its next batch before it can save. But
PyTorch and Python end such processes by SIGTERM, too, which must not be ignored: the run would wait for them for ever.
"""

import multiprocessing
import os
import signal
import threading
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import BaseContext
from multiprocessing.process import BaseProcess

from gelflow.config import TrainConfig


def loading_context(config: TrainConfig) -> BaseContext | None:
    """What starts the loading processes of a run; None: PyTorch's default.

    A run on several devices has threads for their communication. A process that is forked beside them may wait for
    ever for a lock that one of them held. There, a server without threads, which has imported this package, forks.
    """
    if config.workers == 0 or config.devices * config.nodes == 1:
        return None
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__package__])
    resource_tracker.ensure_running()  # would else be started by the next call but one, and unblock the signals
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})  # inherited by the server
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)
    return context


def end_with_run(_: int) -> None:
    """Prepares a loading process: ignores Ctrl-C, and ends at the run's SIGTERM and with the run alone."""
    run = multiprocessing.parent_process()
    if run is None:
        raise RuntimeError("end_with_run: call it in a process that multiprocessing started")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # else it ends this process whoever sends it
    for target in (_await_signal, _await_end):
        threading.Thread(target=target, args=(run,), daemon=True).start()


def _await_signal(run: BaseProcess) -> None:
    while signal.sigwaitinfo({signal.SIGTERM}).si_pid != run.pid:
        pass
    os._exit(0)


def _await_end(run: BaseProcess) -> None:
    run.join()  # PyTorch watches the process that forked this one, which may be the server and not the run
    os._exit(0)
