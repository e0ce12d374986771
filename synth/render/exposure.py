"""Whether a picture's light suits the camera: what is clipped, dark or flat in it, and by what factor to change light.

A level is a pixel's value as a share of white. Rule of thumb: the brightest per cent of the gel lies at 85 % of white,
in the channel where it is brightest.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, Image
from synth.render.camera_image import expected_signal
from synth.scene import Camera

AIM, DARK = 0.85, 0.05
"""Level that the brightest per cent of the gel should have, and below which pixels are called dark."""
MOST_BLIND, LEAST_BRIGHT, LEAST_SPREAD = 0.02, 0.4, 0.02
"""Bounds of what is told: share of blind pixels, level of the brightest per cent, standard deviation of levels."""
BLIND = 20
"""A pixel is blind where most around it are white, in a square whose side is the picture's longest over this number."""


@dataclass(frozen=True)
class Levels:
    """Levels of one channel: mean, standard deviation, least of the brightest per cent; shares at white, below DARK.

    White areas in which no motion can be seen are `blind`; small ones, such as white dots, are not.
    """

    channel: str
    mean: float
    spread: float
    bright: float
    clipped: float
    dark: float
    blind: float


def levels_of(image: NDArray[np.uint8] | NDArray[np.uint16], gel: BoolArray) -> list[Levels]:
    """The levels of an image (H, W) or (H, W, 3) by channel, where pixels (H, W) show gel: at least one."""
    import cv2

    white, side = np.iinfo(image.dtype).max, max(3, max(image.shape) // BLIND)
    found = []
    for channel, whole in zip(
        ("grey",) if image.ndim == 2 else ("red", "green", "blue"), np.moveaxis(np.atleast_3d(image), 2, 0), strict=True
    ):
        values, blind = whole[gel], cv2.blur((whole == white).astype(np.float32), (side, side))[gel] > 0.5
        numbers = values.mean(), values.std(), np.percentile(values, 99)
        shares = (values == white).mean(), (values < DARK * white).mean(), blind.mean()
        found.append(Levels(channel, *(float(number / white) for number in numbers), *map(float, shares)))
    return found


def fault(levels: list[Levels]) -> str:
    """What is wrong with a picture's light; empty where nothing is."""
    worst, bright = max(levels, key=lambda one: one.blind), max(one.bright for one in levels)
    spread = max(one.spread for one in levels)
    if worst.blind > MOST_BLIND:
        return f"clipped: {100 * worst.clipped:.0f} % of the gel's pixels are at white in {worst.channel}"
    if bright < LEAST_BRIGHT:
        return f"dark: the brightest per cent of the gel's pixels is at {100 * bright:.0f} % of white"
    if spread < LEAST_SPREAD:
        return f"flat: levels on the gel have a standard deviation of {100 * spread:.1f} % of white"
    return ""


def light_factor(radiance: Image, gel: BoolArray, camera: Camera) -> float:
    """By what to multiply all lights' power, or the exposure, for a radiance (H, W, C) to meet the rule of thumb.

    Nothing is clipped in it, so that the factor holds however bright the picture is.
    """
    signal = expected_signal(radiance, camera)[gel]
    return float(AIM**camera.gamma / np.percentile(signal, 99, axis=0).max())
