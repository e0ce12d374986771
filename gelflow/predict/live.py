"""Flow of a running camera, and how late it is."""

import time
from collections import deque
from collections.abc import Generator, Iterator
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import Estimate, FlowArray, Frame
from gelflow.errors import InputError
from gelflow.files.video import newest_frames
from gelflow.methods.fast import Fast
from gelflow.methods.method import Method
from gelflow.predict.prediction import Motion, motion_of
from gelflow.predict.stream import Indexed, Reference, Stream, followed

LAST = 300
"""Frames over which latency and rate are measured."""


class LiveFlow(NamedTuple):
    """The newest frame, the flow that leads to it, its motion, and the markers, if they were asked for.

    `latency_s` is the time from the frame's arrival to the flow, `left_out` the number of frames before this one that
    came while the last one was computed.
    """

    frame: Frame
    found: Estimate
    motion: Motion
    markers: NDArray[Any] | None
    latency_s: float
    left_out: int


def follow(
    method: Method,
    source: str,
    reference: Reference = "first",
    markers: bool = False,
    places: FlowArray | None = None,
) -> Generator[LiveFlow, None, None]:
    """Yields the flow to each newest frame, from the first frame or from the one that was used before.

    The source is as `newest_frames` takes it, the rest as for `followed`. InputError where it does not open or gives
    fewer than two frames, its frames change their size, or the method cannot use them.
    """
    arrivals: deque[tuple[int, float]] = deque(maxlen=2)
    if isinstance(method, Fast):  # libraries load before the first frame can wait for them
        noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
        Stream(method, noise, "first", markers=False).update(noise)
    with closing(newest_frames(source)) as newest:

        def noted() -> Iterator[Indexed]:
            for index, time_s, frame, arrived in newest:
                arrivals.append((index, arrived))
                yield index, time_s, frame

        for (index, time_s, frame), (found, seconds, moved) in followed(
            method, noted(), lambda _: source, reference, markers, places, wait=False
        ):
            latency_s = time.monotonic() - arrivals[-1][1]
            left_out = index - arrivals[0][0] - 1
            motion = motion_of(found, index, source, time_s, seconds)
            yield LiveFlow(frame, found, motion, moved, latency_s, left_out)
    if len(arrivals) < 2:
        raise InputError(f"{source}: fewer than two frames came; does another program use the camera?")


class Pace:
    """Latency and rate as they were measured over the last `LAST` frames, and the frames left out so far."""

    def __init__(self) -> None:
        self._latencies: deque[tuple[float, float]] = deque(maxlen=LAST)
        self.left_out = 0

    def add(self, flow: LiveFlow) -> None:
        self._latencies.append((flow.latency_s, time.monotonic()))
        self.left_out += flow.left_out

    def __str__(self) -> str:
        if not self._latencies:
            return "no flow"
        latencies, times = zip(*self._latencies, strict=True)
        median, most = 1e3 * np.percentile(latencies, (50, 95))
        rate = (len(times) - 1) / max(times[-1] - times[0], 1e-9)
        words = f"latency {median:.0f} ms in the median, {most:.0f} ms at 95 %"
        return f"{words}; {rate:.1f} frames/s, {self.left_out} left out"
