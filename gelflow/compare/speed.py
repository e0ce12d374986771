"""How fast a network is and how much memory it takes.

Pairs per second: batches of random images, after warm-up, the median of several. Memory: on a CUDA device the most
that torch held at once beyond the network's weights and the inputs; on Linux the growth of the process's resident
memory to its peak; elsewhere unknown.
"""

import ctypes
import statistics
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gelflow.hardware import hardware, process_memory

CLEAR_PEAK = Path("/proc/self/clear_refs")
WARMUP, REPEATS = 2, 5
"""Passes before the measurement, and measured ones."""


@dataclass(frozen=True)
class Speed:
    """Throughput and memory (None where unknown) of a network's forward pass over a batch of pairs of one size."""

    pairs_per_second: float
    memory_mib: float | None
    batch: int
    size: tuple[int, int]
    device: str


def network_speed(model: Any, size: tuple[int, int], batch: int, device: str) -> Speed:
    """Measures the pass of a network that takes two image batches (B, 3, H, W) on the device."""
    import torch

    random = torch.Generator().manual_seed(0)
    images = [torch.rand(batch, 3, *size, generator=random).to(device) for _ in range(2)]
    synchronise = torch.cuda.synchronize if device == "cuda" else lambda: None
    seconds = []
    with torch.no_grad():
        start = _start_memory(device)
        for _ in range(WARMUP):
            model(*images)
        for _ in range(REPEATS):
            synchronise()
            started = time.perf_counter()
            model(*images)
            synchronise()
            seconds.append(time.perf_counter() - started)
    peak = float(torch.cuda.max_memory_allocated()) if device == "cuda" else process_memory(peak=True)
    memory = None if peak is None or start is None else max(0.0, (peak - start) / 2**20)
    return Speed(batch / statistics.median(seconds), memory, batch, size, hardware(device))


def _start_memory(device: str) -> float | None:
    """Bytes held now, from which the peak is counted anew."""
    import torch

    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return float(torch.cuda.memory_allocated())
    try:
        with suppress(AttributeError):  # a C library other than glibc
            ctypes.CDLL(None).malloc_trim(0)  # give back what earlier passes left in the heap
        CLEAR_PEAK.write_text("5", encoding="ascii")  # Linux: forget the peak of the resident memory
    except OSError:
        return None
    return process_memory(peak=False)
