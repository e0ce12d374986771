"""Values of an image or a field between its pixel centres: cubic convolution (Keys 1981, a = -1/2).

Exact for polynomials of second degree, third-order accurate, local (4 x 4 pixels), so that a NaN or a border spoils
only what touches it. OpenCV's `remap` would round positions to 1/32 px and is of no use for flows of 1e-3 px.

Reference: R. Keys, "Cubic convolution interpolation for digital image processing", IEEE TASSP 29 (1981).
"""

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray


def sample_at(values: NDArray[np.floating], x: FloatArray, y: FloatArray) -> FloatArray:
    """Values (H, W, C) at image positions.

    Args:
        values: (H, W, C); the value of row r, column c belongs to (c + 0.5, r + 0.5).
        x: (...) px; may be NaN.
        y: (...) px; may be NaN.

    Returns:
        (..., C) float64; NaN where the position is NaN, a pixel with weight is NaN, or such a pixel is outside.
    """
    height, width = values.shape[:2]
    column, row = x - 0.5, y - 0.5
    left, top = np.floor(column), np.floor(row)
    # A position on a pixel centre needs only that pixel in its direction, so it may lie at the image's border.
    inside = _fits(column, left, width) & _fits(row, top, height)
    left, top = (np.where(inside, corner, 0).astype(np.intp) for corner in (left, top))
    across = _weights(np.where(inside, column - left, 0.0))
    down = _weights(np.where(inside, row - top, 0.0))
    total = np.zeros((*x.shape, values.shape[2]))
    for j in range(4):
        r = np.clip(top + j - 1, 0, height - 1)
        for i in range(4):
            weight = (down[j] * across[i])[..., None]
            tap = values[r, np.clip(left + i - 1, 0, width - 1)]
            total += np.where(weight == 0, 0.0, weight * tap)
    return np.where(inside[..., None], total, np.nan)


def _fits(place: FloatArray, first: FloatArray, count: int) -> NDArray[np.bool_]:
    """The pixels that have a weight are inside the image; False for NaN."""
    on_centre = (place == first) & (place >= 0) & (place <= count - 1)
    return on_centre | ((first >= 1) & (first + 2 <= count - 1))


def _weights(t: FloatArray) -> list[FloatArray]:
    """Of the pixels at -1, 0, 1, 2 for a position at t in [0, 1)."""
    return [
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    ]
