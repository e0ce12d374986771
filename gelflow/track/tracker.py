"""Flow of a stream: each frame against one reference, from where the frame before has led.

The start of a frame is the last flow, moved on by what DIS sees between the last two frames:
``V(x) = U(x) + D(x + U(x))``. Registration between the reference and the frame then corrects it, so that errors do not
add up, and motion may grow beyond what a direct flow finds. Where the result tears more of the picture than before, as
one does that took dots for the next ones, starts that know nothing of the stream compete with it: DIS from the
reference, and a network if that tears, too (`gelflow.fast.start`). What they lead to must tear clearly less. After a
frame in which most of the picture is lost, such as a cut or one of a ramp of exposure, the next one starts afresh.
"""

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import FlowArray, Frame, ImageArray, MapArray
from gelflow.errors import InputError
from gelflow.fast.certainty import Refined, refined
from gelflow.fast.registration import CELL, STAGES, Prepared, indices, register, resized
from gelflow.fast.start import MOST_TORN, dis, fresh_start, shipped
from gelflow.files.image import as_image, check_images, range_factor
from gelflow.methods.fast import FAST, Fast
from gelflow.methods.learned import open_network
from gelflow.models.uncertainty import MAX_SIGMA_PX
from gelflow.models.weights import weights_file
from gelflow.track.markers import Markers

TRACKING = (STAGES[0], STAGES[-1]._replace(steps=1))
"""Stages from the last flow on. The first smooths it, so that errors between marks do not add up over frames."""
RETRY = 10
"""Frames after which they compete again for what the last ones left."""
CLEARLY_LESS = 0.5
"""Share of what the followed flow tears below which a fresh one replaces it; it may have jumped where they are near."""
MOST_QUIET = 80
"""Largest number of frames in which no network is asked on another thread after one that did not help; it doubles."""
CUT = 0.5
"""Share of the picture that is lost in a frame which has nothing to do with the one before."""


class Tracked(NamedTuple):
    """What a frame shows, from the reference on.

    `flow` (H, W, 2), px; `sigma` (H, W), px, at most 10: the radius within which 68 % of such flows are right;
    `visible` (H, W), the probability that the point is seen in the frame; `markers` (N,), structured: id, x, y (in the
    reference), u, v, sigma, px, and visible; `seconds` that the update took; and whether it started `afresh`.
    """

    flow: FlowArray
    sigma: MapArray
    visible: MapArray
    markers: NDArray[np.void]
    seconds: float
    afresh: bool


class Tracker:
    """Follows a stream of frames from a reference, on one core of the processor. Memory does not grow with frames.

    Args:
        reference: The gel at rest, or whatever motion is counted from: (H, W, 3), (H, W, 4) or (H, W), uint8, uint16 or
            float in [0, 1]; each side has 16 px or more. Larger images than 400 x 300 px are reduced.
        weights: The network that is asked where DIS, too, loses the stream: "fast", the shipped one without its
            registration; "best" or a file of weights, that one with what it comes with.
        wait: Whether the frame in which the stream is lost waits for the network, for half a second or so. If not, the
            network is asked on another thread. Until it answers, frames go on with what is known; sigma is 10 px where
            the stream is lost.
        scene: None alone is allowed; motion and markers are in px.

    Raises:
        InputError: An image that is none, no such weights, or a scene.

    Examples:
        >>> import gelflow, numpy as np
        >>> reference = np.random.default_rng(0).integers(0, 256, (64, 80, 3), np.uint8)
        >>> gelflow.Tracker(reference).update(np.roll(reference, 1, axis=1)).flow.shape
        (64, 80, 2)
    """

    def __init__(
        self, reference: ImageArray | Frame, weights: str | Path = FAST, scene: None = None, wait: bool = True
    ) -> None:
        if scene is not None:
            raise InputError(f"scene = {scene!r}: millimetres are not known here; give None, and take px")
        method = open_network(weights_file(Path(weights)))
        self._network = shipped if isinstance(method, Fast) else method.flow
        self._thread = None if wait else ThreadPoolExecutor(1)
        self.reset(reference)

    def reset(self, reference: ImageArray | Frame | None = None) -> None:
        """Forgets the stream; a reference, of any size, replaces the former one and its markers."""
        if reference is not None:
            image = as_image("the reference", reference)
            check_images(image, image)
            self._factor = np.float32(range_factor(float(image.max())))
            self._image = self._factor * image
            self._first, self._markers = Prepared(self._image), Markers(self._image)
        self._last: tuple[Prepared, Refined] | None = None
        self._asked: tuple[FlowArray, Future[FlowArray]] | None = None  # motion since the frame of the question
        self._quiet, self._pause, self._fresh_since = 0, RETRY, False
        self._since, self._accepted = 0, 0.0
        self._time_s = -math.inf

    def update(self, frame: ImageArray | Frame, time_s: float | None = None) -> Tracked:
        """Finds the flow from the reference to the next frame.

        Args:
            frame: As the reference, of its size.
            time_s: When the frame was taken, s; later than the frame before. It is only checked.

        Raises:
            InputError: Another size than the reference's, values that are none of an image, or a time that is not
                later. The frame then counts as not given.
        """
        started = time.perf_counter()
        image = self._factor * as_image("the frame", frame)
        check_images(self._image, image)
        if time_s is not None:
            if not time_s > self._time_s:
                words = "times must rise; for another stream, reset()"
                raise InputError(f"time_s = {time_s:g} after {self._time_s:g}: {words}")
            self._time_s = time_s
        found, afresh = self._follow(image)
        estimate = found.estimate(self._first)
        markers = self._markers.at(estimate, image)
        return Tracked(*estimate, markers, time.perf_counter() - started, afresh)

    def _follow(self, image: ImageArray) -> tuple[Refined, bool]:
        """The flow to a frame, and whether it started afresh."""
        second, flows, afresh = Prepared(image), list[FlowArray](), self._last is None
        columns = second.grey.shape[1]
        self._since, self._quiet = self._since + 1, self._quiet - 1
        if self._last is not None:
            before, last = self._last
            motion = dis("ultrafast", before.grey, second.grey)
            flows.append(_moved_on(last.flow, motion, columns))
            if self._asked is not None:
                self._asked = (_moved_on(self._asked[0], motion, columns), self._asked[1])
            found = refined(register(flows[0], self._first, second, TRACKING), self._first, second, last)
            self._accepted = min(self._accepted, found.torn)
        start, answered = None, None
        if self._asked is not None and self._asked[1].done():
            answered, self._asked = self._asked, None
            if self._fresh_since or found.torn > MOST_TORN:
                moved = _moved_on(answered[1].result(), answered[0], columns)
                start = register(moved, self._first, second, STAGES[:1])
        elif afresh or found.torn > (self._accepted if self._since < RETRY else 0.0) + MOST_TORN:
            start = fresh_start(self._first, second, flows, self._ask)
        if start is not None:
            fresh = refined(register(start, self._first, second, STAGES[1:]), self._first, second)
            # What began with DIS meanwhile knows as little of the stream as the network does.
            if answered is not None and self._fresh_since:
                afresh = afresh or fresh.torn <= found.torn
            else:
                afresh = afresh or fresh.torn < CLEARLY_LESS * found.torn
            found = fresh if afresh else found
            self._since, self._accepted = 0, found.torn
            self._fresh_since = afresh and answered is None
            if answered is not None:
                self._pause = RETRY if afresh else min(2 * self._pause, MOST_QUIET)
                self._quiet = self._pause
        if found.lost.mean() > CUT:
            self._last = self._asked = None
            return found._replace(sigma=np.full_like(found.sigma, MAX_SIGMA_PX)), True
        self._last = (second, found)
        return found, afresh

    def _ask(self, image1: ImageArray, image2: ImageArray) -> FlowArray | None:
        """The network's flow to a frame; None where it will come later."""
        if self._thread is None:
            return self._network(image1, image2)
        if self._asked is None and self._quiet <= 0:
            none = np.zeros((image2.shape[0] // CELL, image2.shape[1] // CELL, 2), np.float32)
            self._asked = (none, self._thread.submit(self._network, image1, image2))
        return None


def _moved_on(flow: FlowArray, since: FlowArray, columns: int) -> FlowArray:
    """A flow on its grid followed by the motion since, both in px of a picture with so many columns."""
    height, width = flow.shape[:2]
    places = indices(height, width) + flow * (width / columns)
    return flow + cv2.remap(
        resized(since, (height, width)), places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
