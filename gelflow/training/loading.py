"""Processes that load data: how they begin, and that they end when their run says so, not by the signals that ask it
to stop.

Ctrl-C and SIGTERM reach every process of a group or a job, and the run wants its next batch before it can save. But
PyTorch and Python end such processes by SIGTERM, too, which must not be ignored: the run would wait for them for ever.

Resident pairs are decoded once and stay on the CUDA device: there, decoding files would take far longer than training.
Images whose values are whole 255ths stay bytes; everything else is float32, so that samples are those of the files bit
by bit.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import BaseContext, ForkServerContext, ForkServerProcess
from multiprocessing.process import BaseProcess
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from gelflow.config import TrainConfig
from gelflow.training.samples import CheckedPairs, Sample


class _Loader(ForkServerProcess):
    """A process that does not run the user's script again, which would train in it where no main guard keeps it."""

    def start(self) -> None:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            super().start()
        finally:
            sys.modules["__main__"] = main


class _ForkServerContext(ForkServerContext):
    Process = _Loader


def loading_context(config: TrainConfig) -> BaseContext | None:
    """What starts the loading processes of a run; None: PyTorch's default.

    A run on several devices has threads for their communication. A process that is forked beside them may wait for
    ever for a lock that one of them held. There, a server without threads, which has imported this package, forks.
    """
    if config.workers == 0 or config.devices * config.nodes == 1:
        return None
    context = _ForkServerContext()
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


SHARE_OF_MEMORY = 0.5
"""Largest share of the device's free memory that pairs may take."""


class ResidentPairs(Dataset[Sample]):
    """Checked samples on a device; see `resident`."""

    def __init__(self, samples: list[Sample]) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> Sample:
        return {key: _unpacked(value) for key, value in self._samples[index].items()}


def resident(
    pairs: CheckedPairs, device: torch.device, *, room: int | None = None, **loading: Any
) -> ResidentPairs | None:
    """Decodes all pairs and puts them on a device; None where they do not fit. InputError for one that cannot be used.

    `room` is the number of bytes that they may take; None: half of what is free on the CUDA device. `loading` says how
    the DataLoader that decodes them starts its processes; empty: this process decodes.
    """
    if room is None:
        room = int(SHARE_OF_MEMORY * torch.cuda.mem_get_info(device)[0])
    samples: list[Sample] = []
    with _one_thread():
        for sample in DataLoader(pairs, batch_size=None, **loading):
            packed = {key: _packed(value) for key, value in sample.items()}
            room -= sum(value.nbytes for value in packed.values() if isinstance(value, Tensor))
            if room < 0:
                return None
            samples.append({key: v.to(device) if isinstance(v, Tensor) else v for key, v in packed.items()})
    return ResidentPairs(samples)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Single images keep no more threads of PyTorch busy: dozens spin, and for minutes where two runs share a host."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _packed(value: Any) -> Any:
    if not isinstance(value, Tensor) or value.shape[0] != 3:
        return value
    levels = (255 * value).round()
    return levels.to(torch.uint8) if torch.equal(levels.clamp(0, 255) / 255, value) else value


def _unpacked(value: Any) -> Any:
    return (value.double() / 255).float() if isinstance(value, Tensor) and value.dtype == torch.uint8 else value
