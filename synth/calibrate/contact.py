r"""Where a ball touches the gel in a frame, and from where its flanks are lit.

Over the contact of a ball the slope of the gel rises evenly from its middle, so that each channel changes by a plane,

.. math::  D(x, y) = b + g \cdot (x - x_0, y - y_0) / a

with the circle's radius a. The azimuth of g says from which side the light comes; its length is the rise, the change of
the level from the middle to the edge. The circle is the one whose planes explain most and miss least.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize

from synth.arrays import BoolArray, FloatArray, Pixels
from synth.errors import InputError

_BLUR_PX, _GRID = 2.0, 48
"""Smoothing in which contacts are sought, and points of the search along the width of the image."""
_RADII = np.geomspace(0.05, 0.35, 16)
"""Radii that are tried, over the width of the image."""
_INSIDE, _TOUCHING = 0.7, 0.85
"""Least distance of the middle from the image's edges, and radius of the contact, over that of the slope that is seen:
the gel slopes evenly a little beyond where it touches."""
_LEAST_RISE, _LEAST_EXPLAINED = 6.0, 0.5
"""Levels of 255 that a contact's strongest channel must rise, and the share of its slopes that planes must explain."""


@dataclass(frozen=True)
class Contact:
    """A ball's contact: middle (x, y) and radius of its circle in px."""

    middle: tuple[float, float]
    radius: float

    def away(self, shape: tuple[int, ...]) -> FloatArray:
        """(H, W): distance of a picture's pixels from the middle, over the radius."""
        y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
        return np.asarray(np.hypot(x - self.middle[0], y - self.middle[1]) / self.radius)


def change(frame: FloatArray, rest: FloatArray, bare: BoolArray, blur_px: float = _BLUR_PX) -> FloatArray:
    """What a press changes (H, W, 3) in levels of 255, smoothed over pixels (H, W) that are bare in both frames."""
    weight = cv2.GaussianBlur(bare.astype(np.float64), (0, 0), blur_px)
    blurred = cv2.GaussianBlur((frame - rest) * bare[:, :, None], (0, 0), blur_px)
    return np.asarray(255 * blurred / np.maximum(weight, 1e-3)[:, :, None])


def find_contact(changed: FloatArray, name: str) -> Contact:
    """The circle of a ball's contact by what it changes (H, W, 3); InputError where there is none."""
    height, width = changed.shape[:2]
    step = max(1, width // _GRID)
    values = changed[step // 2 :: step, step // 2 :: step]
    y, x = np.mgrid[: values.shape[0], : values.shape[1]] * float(step) + step // 2 + 0.5

    def explained(circle: FloatArray) -> tuple[float, float, float]:
        """What planes explain on a circle (x, y, radius) more than they miss, as a share too, and the rise there."""
        middle, radius = circle[:2], circle[2]
        inside = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 < radius**2
        if inside.sum() < 8 or np.minimum(middle, [width - middle[0], height - middle[1]]).min() < radius * _INSIDE:
            return 0.0, 0.0, 0.0
        columns = np.column_stack([np.ones(inside.sum()), x[inside] - middle[0], y[inside] - middle[1]])
        within = values[inside]
        normal, moment = columns.T @ columns, columns.T @ within
        planes = np.linalg.solve(normal + 1e-9 * np.eye(3), moment)
        tilted = float(np.sum(moment[1:] * planes[1:]))
        missed = float(np.sum(within**2) - np.sum(moment * planes))
        return tilted - missed, tilted / max(tilted + missed, 1e-9), radius * float(np.hypot(*planes[1:]).max())

    grid = np.stack([x, y], axis=-1)[::2, ::2].reshape(-1, 2)
    tried = [np.append(middle, radius) for radius in _RADII * width for middle in grid]
    best = max(tried, key=lambda circle: explained(circle)[0])
    values = changed  # every pixel from here on
    y, x = np.mgrid[:height, :width] + 0.5
    simplex = best + np.vstack([np.zeros(3), np.diag([step, step, 0.1 * best[2]])])
    best = minimize(
        lambda circle: -explained(circle)[0],
        best,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 80},
    ).x
    _, share, rise = explained(best)
    if rise < _LEAST_RISE or share < _LEAST_EXPLAINED:
        raise InputError(
            f"{name}: no ball's contact is seen in it; give frames of a ball pressed in, away from the edges"
        )
    return Contact((float(best[0]), float(best[1])), float(_TOUCHING * best[2]))


def flanks(pixels: Pixels, changed: FloatArray, contact: Contact) -> tuple[FloatArray, FloatArray]:
    """Azimuth (3,) in degrees, 0 to the right and 90 downward, and rise (3,) in levels of 255, by channel.

    Of the changes (n, 3) in levels at pixels (n, 2), those within the circle count.
    """
    u, v = ((pixels - contact.middle) / contact.radius).T
    inside = u**2 + v**2 < 1
    columns = np.column_stack([np.ones(inside.sum()), u[inside], v[inside]])
    planes = np.linalg.lstsq(columns, changed[inside], rcond=None)[0]
    return np.degrees(np.arctan2(planes[2], planes[1])), np.hypot(planes[1], planes[2])
