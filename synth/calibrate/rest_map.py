"""A rest map (`synth.render.rest_map`) measured: the frames at rest over the fitted sensor's picture, both linear.

It is a smooth field, the quotient of both in Gaussian neighbourhoods, with specks: the quotient of single pixels, where
their difference stands out from what noise and the gel's grain make everywhere. Dots belong to the gel, so they are
left out; so is what is clipped or nearly black in either picture. There the field is continued from the surroundings.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.calibrate.comparison import Comparison
from synth.calibrate.frames import PLACE

_ONE = 2**15
"""A factor of 1 in a picture of 16 bits."""
_RANGE = 0.02, 0.99
"""Encoded levels that tell a factor."""
_WIDE, _SHARE = 8, 1e-3
"""Width of the neighbourhoods that continue the field, over that of a place, and their weight beside it."""
_SPECK = 5.0
"""Standard deviations of fine detail, by its median, beyond which it is a speck."""


def measured_rest_map(row: Comparison, gamma: float) -> NDArray[np.uint16]:
    """The map (H, W, 3) RGB, to be stored as a PNG of 16 bits, from a comparison of frames at rest."""
    useful = [(image > _RANGE[0]) & (image < _RANGE[1]) for image in (row.frame, row.rendered)]
    known = np.asarray(row.outside & (useful[0] & useful[1]).all(axis=2))[:, :, None].astype(np.float64)
    frame, rendered = known * row.frame**gamma, known * row.rendered**gamma
    near = PLACE * row.frame.shape[1]
    above, below = (
        cv2.GaussianBlur(image, (0, 0), near) + _SHARE * cv2.GaussianBlur(image, (0, 0), _WIDE * near)
        for image in (frame, rendered)
    )
    field = np.where(below > 0, above / np.maximum(below, 1e-300), 1.0)
    detail = known * (row.frame - (rendered * field) ** (1 / gamma))  # encoded: there noise differs least
    local = np.abs(cv2.GaussianBlur(detail, (0, 0), 1.0))
    spread = np.median(local[known[:, :, 0] > 0], axis=0) / 0.6745  # of a Gaussian, the standard deviation
    speck = cv2.dilate((local > _SPECK * spread).astype(np.uint8), np.ones((3, 3), np.uint8)) * known > 0
    factors = np.where(speck, frame / np.maximum(rendered, 1e-300), field)
    return np.clip(np.round(factors * _ONE), 0, 2 * _ONE - 1).astype(np.uint16)


def with_rest_map(row: Comparison, rest_map: NDArray[np.uint16], gamma: float) -> Comparison:
    """The comparison with the map in the fitted sensor's picture."""
    return replace(row, rendered=np.clip(row.rendered**gamma * (rest_map / _ONE), 0, 1) ** (1 / gamma))
