"""Specks in the optics: `gelflow.models.specks`, which holds the equations, on every fourth pixel of the image.

With three differences. P is the flow's mean under a Gaussian, taken once more of what it leaves, in place of a linear
function fitted in a ring. A speck may draw the flow only in part. Around a speck, the flow must not explain the images
better than P does, as it does where the gel bends about a place at rest.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import FlowArray, ImageArray, MapArray
from gelflow.fast.registration import CELL, TINY, Prepared, fields, products, window_sums
from gelflow.models.specks import DOUBT, FLOOR_PX, MIN_CONTRAST, MIN_GAIN, MIN_MOTION_PX, MISFITS, NEAR_CELLS, NOISE

WIDTH_PX, FITS = 12.0, 3
"""Standard deviation of the Gaussian under which P is a mean, and how often its outliers are weighed."""
MAX_RATIO = 0.3
"""Largest ratio of squared differences of images where one of them is none."""
BLUR_CELLS, AROUND_CELLS = 0.5, 2.0
"""Standard deviations of the windows of these squares, and of that in which the flow and P are compared."""


def speck_error(flow: FlowArray, texture: MapArray, first: Prepared, second: Prepared) -> MapArray:
    """E in px^2 near specks, else 0; (h, w), as the flow (h, w, 2), px.

    The texture (h, w) is the sum of squared gradients in a window, 0 where it does not tell the flow.
    """
    one, two = first.levels[2], second.levels[2]

    def square(image: ImageArray) -> MapArray:
        return cv2.GaussianBlur(products([(image, image)], one.grid)[0] / 3, (3, 3), BLUR_CELLS)

    still, contrast, left = (square(each) for each in (two.image - one.image, one.image, fields(flow, one, two)[0]))
    stands = (still < MAX_RATIO * contrast) & (contrast > MIN_CONTRAST**2) & (still < 2 * left + NOISE**2)
    weight = texture / (texture + texture.mean() + TINY)
    motion, misfit = _surroundings(flow, np.where(_near(stands, NEAR_CELLS), DOUBT * weight, weight) + TINY)
    moved = square(fields(motion, one, two)[0])
    gain = np.where(_near(stands, 1), 0, (moved - left) / (moved + left + MIN_CONTRAST**2))
    speck = stands & (np.square(motion).sum(axis=-1) > MIN_MOTION_PX**2 + MISFITS**2 * misfit)
    speck &= (still < MAX_RATIO * moved) & (cv2.GaussianBlur(gain, (0, 0), AROUND_CELLS) < MIN_GAIN)
    return _near(speck, NEAR_CELLS) * (np.square(flow - motion).sum(axis=-1) + misfit)


def _surroundings(flow: FlowArray, trusted: MapArray) -> tuple[FlowArray, MapArray]:
    """P (h, w, 2), px, and s^2 (h, w), px^2; `trusted` (h, w) is what the flow counts at each place."""
    weight = trusted
    for _ in range(FITS):
        motion = _mean(flow, weight)
        motion = motion + _mean(flow - motion, weight)
        apart = np.square(flow - motion).sum(axis=-1, keepdims=True)
        misfit = _mean(apart, weight) + FLOOR_PX**2
        weight = trusted / (1 + apart[..., 0] / misfit[..., 0])
    return motion, misfit[..., 0]


def _mean(field: NDArray[np.float32], weight: MapArray) -> NDArray[np.float32]:
    """Means of each channel under the Gaussian, weighted; (h, w, C)."""
    sums = window_sums(np.dstack([weight[..., None] * field, weight]), WIDTH_PX / CELL)
    return sums[..., :-1] / sums[..., -1:]


def _near(place: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    """Where a place is at most some cells away along each axis."""
    return cv2.dilate(place.astype(np.uint8), np.ones((2 * cells + 1,) * 2, np.uint8)) > 0
