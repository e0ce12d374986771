"""How fast a network is and how much memory it takes.

Pairs per second: batches of random images, after warm-up, the median of several. Memory: on a CUDA device the most
that torch held at once beyond the network's weights and the inputs; elsewhere unknown.
"""

import statistics
import time
from dataclasses import dataclass
from typing import Any

import torch

from gelflow.hardware import hardware

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
    random = torch.Generator().manual_seed(0)
    images = [torch.rand(batch, 3, *size, generator=random).to(device) for _ in range(2)]
    synchronise = torch.cuda.synchronize if device == "cuda" else lambda: None
    seconds = []
    with torch.no_grad():
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
            held = torch.cuda.memory_allocated()
        for _ in range(WARMUP):
            model(*images)
        for _ in range(REPEATS):
            synchronise()
            started = time.perf_counter()
            model(*images)
            synchronise()
            seconds.append(time.perf_counter() - started)
    memory = (torch.cuda.max_memory_allocated() - held) / 2**20 if device == "cuda" else None
    return Speed(batch / statistics.median(seconds), memory, batch, size, hardware(device))
