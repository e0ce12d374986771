"""What each kernel of a cycle takes, on a CPU by its clock and on an NVIDIA GPU by events in the stream."""

import time
from itertools import pairwise

import warp as wp

from synth.simulate.batched.gemm import dense


class Clock:
    """Times between marks on the CPU, where a launch ends when the kernel does."""

    def start(self) -> None:
        """Begin."""
        self._marks: list[tuple[str, str, float]] = []
        self._last = time.perf_counter()

    def mark(self, part: str, kernel: str) -> None:
        """Note what ran since the last mark."""
        now = time.perf_counter()
        self._marks.append((part, kernel, 1e3 * (now - self._last)))
        self._last = now

    def stop(self) -> list[tuple[str, str, float]]:
        """Part, kernel and ms of each mark."""
        return self._marks


class Events:
    """The same on CUDA, by events in the stream.

    The GPU is kept busy by other work until the host has queued the whole cycle, so that no time between two events is
    the host's.
    """

    AHEAD_MS, SIZE = 40.0, 4096

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._dense = dense(device)
        matrix = (self.SIZE, self.SIZE)
        self._a, self._b, self._c = (wp.zeros(matrix, dtype=wp.float32, device=device) for _ in range(3))
        self._all = wp.ones(self.SIZE, dtype=wp.int32, device=device)
        self._times = 1
        for _ in range(2):  # the first takes longer
            first = self._event()
            self._be_busy()
            last = self._event()
            wp.synchronize_device(self._device)
        self._times = 1 + int(self.AHEAD_MS / wp.get_event_elapsed_time(first, last))

    def _event(self) -> wp.Event:
        return self._device.stream.record_event(wp.Event(self._device, enable_timing=True))

    def _be_busy(self) -> None:
        for _ in range(self._times):
            self._dense.product(self._a, self._b, self._c, self._all)

    def start(self) -> None:
        """Begin."""
        self._be_busy()
        self._marks = [("", "", self._event())]

    def mark(self, part: str, kernel: str) -> None:
        """Note what was queued since the last mark."""
        self._marks.append((part, kernel, self._event()))

    def stop(self) -> list[tuple[str, str, float]]:
        """Part, kernel and ms of each mark."""
        wp.synchronize_device(self._device)
        pairs = pairwise(self._marks)
        return [(part, kernel, wp.get_event_elapsed_time(last, this)) for (_, _, last), (part, kernel, this) in pairs]
