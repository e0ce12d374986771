"""How many pairs a second a run takes, loading and saving included, validation left out, and its peak memory."""

import time

import torch

from gelflow.hardware import process_memory


class Throughput:
    """Counts pairs from the end of the first step on: that one compiles, allocates and fills caches."""

    def __init__(self) -> None:
        self._pairs = 0
        self._started: float | None = None
        self._paused = 0.0

    def add(self, pairs: int) -> None:
        """Counts the pairs of a step that has ended."""
        if self._started is None:
            self._started = time.perf_counter()
        else:
            self._pairs += pairs

    def pause(self) -> None:
        """Stops the clock, for a validation."""
        self._paused = time.perf_counter()

    def resume(self) -> None:
        """Lets the clock run on."""
        if self._started is not None:
            self._started += time.perf_counter() - self._paused

    @property
    def pairs_per_second(self) -> float | None:
        """Since the first step; None before the second has ended."""
        return self._pairs / (time.perf_counter() - self._started) if self._started and self._pairs else None


def peak_memory_mib() -> float | None:
    """The most memory that torch held on the CUDA device, or on a CPU the process; MiB, None where it is not known."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        return torch.cuda.max_memory_allocated() / 2**20
    peak = process_memory(peak=True)
    return None if peak is None else peak / 2**20
