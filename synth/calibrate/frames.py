"""Frames of a user's sensor: read, and the median taken of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError

_SAME = 6.0
"""Levels of 255 by which half of a frame may differ from the median of all."""


@dataclass(frozen=True, eq=False)
class Frames:
    """What the frames show together: (H, W, 3) float64 RGB in [0, 1], their median, and one with all of its noise.

    The median of three or more shows no contact of a few. `step` is that of one level of quantisation, full scale 1.
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
    import cv2

    if not paths:
        raise InputError("no frames: give one or a few images of the undeformed gel")
    images, steps = [], []
    for path in paths:
        if not path.is_file():
            raise InputError(f"{path}: there is no such file")
        raw = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
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
    return Frames(together, images[0], max(steps))


def _size(image: FloatArray) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"
