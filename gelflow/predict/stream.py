"""Frames of a recording or a camera, one after the other: the flow to each, and the markers that move with it."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

from numpy.typing import NDArray

from gelflow.arrays import Estimate, FlowArray, Frame
from gelflow.errors import InputError
from gelflow.files.image import full_range, in_unit_range
from gelflow.methods.fast import Fast
from gelflow.methods.method import Method, estimated
from gelflow.track.markers import Markers
from gelflow.track.tracker import Tracker

Reference = Literal["first", "previous"]


class Followed(NamedTuple):
    """The flow to a frame, how long it took, s, and the markers, if they were asked for."""

    found: Estimate
    seconds: float
    markers: NDArray[Any] | None


class Stream:
    """The flow of a method from the first frame, or from the previous one, to each next frame.

    The method "fast" tracks (`gelflow.track.tracker`) from the first frame; others see each frame on its own. Markers
    are those of the first frame; InputError where the flow does not come from there. `wait` is as of `Tracker`.
    """

    def __init__(self, method: Method, first: Frame, reference: Reference, markers: bool, wait: bool = True) -> None:
        if markers and reference == "previous":
            raise InputError("--markers: they are followed from the first frame; leave out --reference previous")
        self._method, self._before, self._reference, self._with_markers = method, first, reference, markers
        image = in_unit_range(first)
        self._tracker = Tracker(image, wait=wait) if isinstance(method, Fast) and reference == "first" else None
        self._markers = Markers(full_range(image, image)[0]) if markers and self._tracker is None else None

    def update(self, frame: Frame) -> Followed:
        """Finds the flow to the next frame; InputError where it has another size or the method cannot use it."""
        if frame.shape != self._before.shape:
            raise InputError("has another size than the frame before it")
        if self._tracker is not None:
            tracked = self._tracker.update(frame)
            found = Estimate(tracked.flow, tracked.sigma, tracked.visible)
            return Followed(found, tracked.seconds, tracked.markers if self._with_markers else None)
        images = full_range(in_unit_range(self._before), in_unit_range(frame))
        found, seconds = estimated(self._method, *images)
        if self._reference == "previous":
            self._before = frame
        return Followed(found, seconds, None if self._markers is None else self._markers.at(found, images[1]))


Indexed = tuple[int, float | None, Frame]
"""A frame's number, its time, s, where it has one, and its pixels."""


def followed(
    method: Method,
    frames: Iterable[Indexed],
    named: Callable[[int], str | Path],
    reference: Reference = "first",
    markers: bool = False,
    places: FlowArray | None = None,
    wait: bool = True,
) -> Iterator[tuple[Indexed, Followed]]:
    """Yields each frame but the first with what was found in it.

    InputError where a frame cannot be used or is not of the size of `places`; it says what `named` gives for the
    frame's number.
    """
    stream: Stream | None = None
    for each in frames:
        index, _, frame = each
        try:
            if places is not None and frame.shape[:2] != places.shape[:2]:
                size = f"{places.shape[1]}x{places.shape[0]}"
                raise InputError(f"--scene: it has {size} px, the frame {frame.shape[1]}x{frame.shape[0]}")
            if stream is None:
                stream = Stream(method, frame, reference, markers, wait)
                continue
            found = stream.update(frame)
        except InputError as error:
            raise InputError(f"{named(index)}, frame {index}, {method.name}: {error}") from error
        yield each, found
