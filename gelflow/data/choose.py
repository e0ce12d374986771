"""Choosing pairs of frames with enough motion from one recording.

Frames that show no gel in its usual light are put aside: blank ones, and those of an exposure ramp, whose mean colour
is far from the recording's median. Pairs of the remaining frames are tried in a random order. The motion of a pair is
the 95th percentile of the length of a cheap flow (DIS ultrafast, image reduced to 160 px), in px of the recording:
a percentile near the top, because a local press moves a small part of the gel. A pair is taken if

- its motion lies within the limits,
- the flow there and back closes: median |forward(x) + backward(x + forward(x))| <= 0.5 px + 10 % of the motion;
  otherwise what was measured may not be motion,
- its flow differs from that of every pair taken before by `minimum_difference_px` at the 95th percentile; otherwise
  it shows the same again.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import Bytes3, FlowArray, Grey8

WORKING_SIDE = 160
"""Longer side, in px, of the reduced image on which motion is measured."""
BLANK_STANDARD_DEVIATION = 3.0
"""Grey levels of 255; frames with less contrast show nothing to track."""
EXPOSURE_CHANGE = 0.2
"""Largest relative deviation of a channel's mean from its median over the recording: above what contact changes, below
exposure ramps."""
MOTION_PERCENTILE = 95.0


@dataclass(frozen=True)
class ChoiceConfig:
    """What makes a pair worth taking; lengths are px of the recording.

    At most `frames` frames of a recording, evenly spaced, are looked at, `tries` pairs tried and `per_source` taken, in
    a random order that depends on the seed and the recording's name.
    """

    per_source: int = 10
    minimum_motion_px: float = 2.0
    maximum_motion_px: float = 60.0
    minimum_difference_px: float = 1.0
    frames: int = 40
    tries: int = 200
    seed: int = 0


@dataclass(frozen=True)
class Choice:
    """A pair of frames, by position in the list of frames, and its motion in px."""

    first: int
    second: int
    motion_px: float


@dataclass
class Choices:
    """The pairs taken from one recording, and what was rejected, counted by reason."""

    pairs: list[Choice] = field(default_factory=list)
    frames_rejected: dict[str, int] = field(default_factory=dict)
    tried: int = 0
    rejected: dict[str, int] = field(default_factory=dict)


def usable_frames(frames: Sequence[Bytes3]) -> tuple[list[int], dict[str, int]]:
    """Positions of the frames that show the gel in its usual light, and the number of the others by reason."""
    means = np.array([frame.reshape(-1, 3).mean(axis=0) for frame in frames])
    contrast = np.array([frame.mean(axis=2).std() for frame in frames])
    blank = contrast < BLANK_STANDARD_DEVIATION
    usual = np.median(means[~blank] if (~blank).any() else means, axis=0)
    changed = (np.abs(means - usual) > EXPOSURE_CHANGE * np.maximum(usual, 1.0)).any(axis=1) & ~blank
    rejected = {"blank": int(blank.sum()), "exposure": int(changed.sum())}
    return list(np.flatnonzero(~blank & ~changed)), {reason: n for reason, n in rejected.items() if n}


class MotionMeter:
    """Measures motion between frames of one size. Holds the reduced frames."""

    def __init__(self, frames: Sequence[Bytes3]) -> None:
        height, width = frames[0].shape[:2]
        self.scale = max(1.0, max(height, width) / WORKING_SIDE)
        size = (max(16, round(width / self.scale)), max(16, round(height / self.scale)))
        self.reduced: list[Grey8] = [
            cv2.resize(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA) for frame in frames
        ]
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
        self._columns, self._rows = np.meshgrid(np.arange(size[0], dtype=np.float32),
                                                np.arange(size[1], dtype=np.float32))  # fmt: skip

    def flow(self, first: int, second: int) -> FlowArray:
        """Flow of the reduced images, in px of the recording."""
        flow: FlowArray = self._dis.calc(self.reduced[first], self.reduced[second], None) * np.float32(self.scale)
        return flow

    def closure_px(self, forward: FlowArray, backward: FlowArray) -> float:
        """Median over the image of |forward(x) + backward(x + forward(x))|, px of the recording."""
        columns = self._columns + forward[..., 0] / np.float32(self.scale)
        rows = self._rows + forward[..., 1] / np.float32(self.scale)
        there = cv2.remap(backward, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return float(np.median(length(forward + there)))


def length(flow: FlowArray) -> NDArray[np.float32]:
    """Length of the flow at each pixel, (H, W)."""
    return np.hypot(flow[..., 0], flow[..., 1])


def choose_pairs(frames: Sequence[Bytes3], config: ChoiceConfig, generator: np.random.Generator) -> Choices:
    """Chooses pairs from the frames, of one size, of a recording; which of a pair's comes first is random, too."""
    choices = Choices()
    usable, choices.frames_rejected = usable_frames(frames)
    if len(usable) < 2:
        return choices
    meter = MotionMeter(frames)
    candidates = [(i, j) for i in usable for j in usable if i != j]
    taken: list[FlowArray] = []
    tried: set[tuple[int, int]] = set()
    for position in generator.permutation(len(candidates)):
        first, second = candidates[position]
        if (second, first) in tried:
            continue
        if len(taken) >= config.per_source or choices.tried >= config.tries:
            break
        tried.add((first, second))
        choices.tried += 1
        forward = meter.flow(first, second)
        motion = float(np.percentile(length(forward), MOTION_PERCENTILE))
        reason = None
        if motion < config.minimum_motion_px:
            reason = "little motion"
        elif motion > config.maximum_motion_px:
            reason = "too much motion"
        elif meter.closure_px(forward, meter.flow(second, first)) > 0.5 + 0.1 * motion:
            reason = "unreliable"
        elif any(np.percentile(length(forward - other), MOTION_PERCENTILE) < config.minimum_difference_px
                 for other in taken):  # fmt: skip
            reason = "near duplicate"
        if reason:
            choices.rejected[reason] = choices.rejected.get(reason, 0) + 1
        else:
            taken.append(forward)
            choices.pairs.append(Choice(int(first), int(second), motion))
    return choices
