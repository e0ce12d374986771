"""Frames of a user's sensor: read, and one picture of the gel at rest made of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.errors import InputError
from synth.untrusted import check_picture, read_file

PLACE = 0.02
"""Standard deviation of the Gaussian neighbourhood that makes a place, over the image's width."""
_PRESSED = 8 / 255
"""Difference of a place from the gel at rest beyond which it counts as pressed or shaded, encoded."""
_SAME = 6.0
"""Levels of 255 by which half of a frame may differ from the median of all."""


@dataclass(frozen=True, eq=False)
class Frames:
    """What the frames show together: (H, W, 3) float64 RGB in [0, 1], and one of them with all of its noise.

    Each pixel is the mean of the frames in which it is not pressed; where it is pressed in all, their median. `step` is
    that of one level of quantisation, full scale 1.
    """

    encoded: FloatArray
    single: FloatArray
    step: float

    @property
    def size(self) -> tuple[int, int]:
        return self.encoded.shape[1], self.encoded.shape[0]


def read_frames(paths: Sequence[Path]) -> Frames:
    """Frames of one sensor with its gel at rest or pressed at different places, of 8 or 16 bits, grey or in colour.

    InputError where none is given, one is missing or no image, sizes differ, or frames show different things.
    """
    if not paths:
        raise InputError("no frames: give one or a few images of the undeformed gel")
    images, steps = [], []
    for path in paths:
        try:
            content = read_file(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
        check_picture(content, str(path))
        raw = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        if raw is None or raw.dtype not in (np.uint8, np.uint16):
            raise InputError(f"{path}: is no image of 8 or 16 bits that OpenCV can read, such as a PNG")
        steps.append(1.0 / float(np.iinfo(raw.dtype).max))
        images.append(raw[:, :, ::-1].astype(np.float64) * steps[-1])
        if images[-1].shape != images[0].shape:
            raise InputError(
                f"{path}: has {_size(images[-1])} pixels, {paths[0]} has {_size(images[0])}; give one size"
            )
    together = np.median(images, axis=0)
    for path, image in zip(paths, images, strict=True):
        difference = 255 * float(np.median(np.abs(image - together)))
        if difference > _SAME:
            raise InputError(
                f"{path}: half of it differs from the frames' median by {difference:.1f} of 255 and more (allowed are "
                f"{_SAME:g}); all frames must show the same gel, at rest or pressed at different places"
            )
    pressed = np.array([~at_rest(image, together)[0] for image in images])
    mean = np.ma.array(images, mask=np.repeat(pressed[..., None], 3, axis=-1)).mean(axis=0)
    return Frames(mean.filled(together), images[0], max(steps))


def at_rest(frame: FloatArray, rest: FloatArray) -> tuple[BoolArray, FloatArray]:
    """The pixels (H, W) of a bare gel's frame that are not pressed, and its picture at rest, smoothed, (H, W, 3).

    Both frames are smoothed by a Gaussian of 2 % of the width. A pixel counts as pressed, or as shaded by what is, if
    they differ by more than 8 of 255 levels in any channel there or within that distance.
    """
    sigma = PLACE * frame.shape[1]
    smooth, plain = (cv2.GaussianBlur(each, (0, 0), sigma) for each in (frame, rest))
    pressed = (np.abs(smooth - plain).max(axis=2) > _PRESSED).astype(np.uint8)
    near = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(sigma) + 1,) * 2)
    return cv2.dilate(pressed, near) == 0, plain


def _size(image: FloatArray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
