"""Flow of a running camera, and how late it is."""

import time
from collections import deque
from collections.abc import Generator, Iterator
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import Bytes3, Estimate, FlowArray
from gelflow.baselines.method import Method
from gelflow.errors import InputError
from gelflow.files.image import full_range, in_unit_range, to_bytes
from gelflow.files.video import newest_frames
from gelflow.predict.prediction import Motion, motion_of
from gelflow.predict.stream import Indexed, Reference, followed

LAST = 300
"""Frames over which latency and rate are measured."""


class LiveFlow(NamedTuple):
    """The newest frame, the flow that leads to it, its motion, and the markers, if they were asked for.

    `latency_s` is the time from the frame's arrival to the flow, `left_out` the number of frames before this one that
    came while the last one was computed.
    """

    frame: Bytes3
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
    with closing(newest_frames(source)) as newest:

        def noted() -> Iterator[Indexed]:
            for index, time_s, frame, arrived in newest:
                arrivals.append((index, arrived))
                yield index, time_s, frame

        for (index, time_s, frame), (found, seconds, moved) in followed(
            method, noted(), lambda _: source, reference, markers, places
        ):
            latency_s = time.monotonic() - arrivals[-1][1]
            left_out = index - arrivals[0][0] - 1
            image = in_unit_range(frame)
            motion = motion_of(found, index, source, time_s, seconds)
            yield LiveFlow(to_bytes(full_range(image, image)[0]), found, motion, moved, latency_s, left_out)
    if len(arrivals) < 2:
        raise InputError(f"{source}: fewer than two frames came; does another program use the camera?")


class Pace:
    """Latency and rate as they were measured over the last `LAST` frames, and the frames left out so far."""

    def __init__(self) -> None:
        self._latencies: deque[float] = deque(maxlen=LAST)
        self._times: deque[float] = deque(maxlen=LAST)
        self._left_out = 0

    def add(self, flow: LiveFlow) -> dict[str, float]:
        """Counts a frame; its latency, median and 95 % of latencies, s, frames per second, and frames left out."""
        self._latencies.append(flow.latency_s)
        self._times.append(time.monotonic())
        self._left_out += flow.left_out
        median, most = np.percentile(self._latencies, (50, 95))
        lasted = self._times[-1] - self._times[0]
        return {
            "latency_s": flow.latency_s,
            "latency_median_s": float(median),
            "latency_95_s": float(most),
            "frames_per_s": (len(self._times) - 1) / lasted if lasted > 0 else 0.0,
            "left_out": self._left_out,
        }
