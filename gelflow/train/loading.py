"""Processes that load data end with the run: when its process says so, not by the signals that ask the run to stop.

Ctrl-C and SIGTERM reach every process of a group or a job, and the run wants its next batch before it can save. But
PyTorch and Python end such processes by SIGTERM, too, which must not be ignored: the run would wait for them for ever.
"""

import os
import signal
import threading


def end_with_run(_: int) -> None:
    """Prepares a loading process: ignores Ctrl-C, and ends at the run's SIGTERM alone. For `worker_init_fn`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # else it ends this process whoever sends it
    threading.Thread(target=_wait_for, args=(os.getppid(),), daemon=True).start()


def _wait_for(run: int) -> None:
    while signal.sigwaitinfo({signal.SIGTERM}).si_pid != run:
        pass
    os._exit(0)
