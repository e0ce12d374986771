"""Blobs of an image: dots, pins and other convex marks, each found on its own, without a pattern.

They stand out at several thresholds (OpenCV's `SimpleBlobDetector`). A blob's centre is the centroid of its darkness
(or brightness) against a plane fitted to a ring around it.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import Grey8, PointArray

SIZES = (0.6, 1.6)
"""Diameters of marks that belong to the pattern, over the median."""
THRESHOLD_STEP = 5
"""Grey levels between the thresholds, at three of which or more a mark must stand out."""


def blobs(grey: Grey8) -> NDArray[np.float64]:
    """Column, row and diameter, (N, 3) px, of the marks darker or of those brighter than around, whichever are more."""
    return max((_of_colour(grey, colour) for colour in (0, 255)), key=len)


def inside_by(points: PointArray, shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """Whether points (N, 2) lie at least `margin` px from the border of an image of the shape (rows, columns, ...)."""
    last = np.array([shape[1], shape[0]]) - 1
    return np.asarray(((points >= margin) & (points <= last - margin)).all(axis=1))


def _of_colour(grey: Grey8, colour: int) -> NDArray[np.float64]:
    """Column, row and diameter, (N, 3) px, of convex marks darker (0) or brighter (255) than what surrounds them."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = THRESHOLD_STEP, 255, THRESHOLD_STEP
    settings.minRepeatability, settings.minDistBetweenBlobs = 3, 4
    settings.blobColor = colour
    settings.minArea, settings.maxArea = 9, grey.size / 25
    settings.filterByCircularity, settings.minConvexity, settings.minInertiaRatio = False, 0.8, 0.15
    found = cv2.SimpleBlobDetector.create(settings).detect(grey)
    return np.array([(*mark.pt, mark.size) for mark in found], np.float64).reshape(-1, 3)


def blob_centre(values: NDArray[np.float64], column: float, row: float, diameter: float) -> NDArray[np.float64]:
    """Centroid (2,) px of what differs from a plane through the ring around a mark; the first guess if that fails."""
    reach = 0.65 * diameter + 1.5
    centre = first = np.array([column, row])
    for _ in range(3):
        left, top = np.maximum(0, np.floor(centre - reach - 2)).astype(int)
        right, bottom = np.ceil(centre + reach + 3).astype(int)
        patch = values[top:bottom, left:right]
        y, x = np.indices(patch.shape) + np.array([top, left]).reshape(2, 1, 1)
        radius = np.hypot(x - centre[0], y - centre[1])
        ring, disc = (radius > reach) & (radius < reach + 2), radius <= reach
        terms = np.stack([np.ones_like(x), x - centre[0], y - centre[1]], axis=-1)
        plane, *_ = np.linalg.lstsq(terms[ring], patch[ring], rcond=None)
        height = np.abs(np.where(disc, patch - terms @ plane, 0.0))
        # Noise and shading of the coating weigh nothing; cut off at once, pixels at the limit would come and go.
        weight = np.maximum(height - 0.15 * np.percentile(height[disc], 90), 0.0)
        if not weight.any():
            return first
        centre = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        if np.abs(centre - first).max() > diameter / 2:
            return first
    return centre
