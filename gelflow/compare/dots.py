"""Dots found in both images of a pair: how near to them a flow leads, with nothing tracked and no exact flow.

Marks are found in each image alone, dark or bright, whichever are more: blobs that stand out at several thresholds
(OpenCV's `SimpleBlobDetector`). They are a pattern of dots where there are enough of them, of about one size and about
equally far from the nearest other; the grains of speckle are not. A dot's centre is the centroid of its darkness (or
brightness) against a plane fitted to a ring around it.

A dot of image 1 is moved by the flow and compared with the nearest dot of image 2. The distance does not tell which of
the dots that is: a flow that is wrong by a whole pitch of the pattern leads to dots, too.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from gelflow.arrays import FlowArray, Grey8, ImageArray, PointArray
from gelflow.compare.metrics import moved_points
from gelflow.files.image import to_grey

FEWEST = 12
"""Dots that make a pattern."""
MAX_SPREAD = 0.09
"""Largest spread of the dots' diameters in a pattern, and of their distances to the nearest other: median deviation
from the median, as a share of it."""
SIZES = (0.6, 1.6)
"""Diameters of marks that belong to the pattern, over the median."""
THRESHOLD_STEP = 5
"""Grey levels between the thresholds, at three of which or more a mark must stand out."""
OWN_PITCHES = 0.25
"""Distance within which a moved dot reaches one of image 2, as a share of the pitch."""


@dataclass(frozen=True, eq=False)
class Dots:
    """Centres (N, 2) of the dots that lie wholly in an image, and their median diameter, px."""

    centres: PointArray
    diameter_px: float


@dataclass(frozen=True)
class DotDistance:
    """Distance in px from dots moved by a flow to the nearest dots of image 2.

    Median and 90th percentile are over the dots that stay a diameter away from the image's border. `own` is the share
    of all dots of image 1 that reach one of their own: within a quarter of the pitch, and nearer to it than any other.
    """

    median_px: float
    p90_px: float
    own: float


def find_dots(image: ImageArray) -> Dots | None:
    """Finds the dots of an image; None where it shows no pattern of dots."""
    grey = to_grey(image)
    marks = max((_marks(grey, colour) for colour in (0, 255)), key=len)
    if len(marks) < FEWEST:
        return None
    size, apart = marks[:, 2] / np.median(marks[:, 2]), _nearest_other(marks[:, :2])
    if max(np.median(np.abs(size - 1)), np.median(np.abs(apart / np.median(apart) - 1))) > MAX_SPREAD:
        return None
    diameter = float(np.median(marks[:, 2]))
    whole = _inside(marks[:, :2], grey.shape, 0.6 * diameter)
    marks = marks[(size > SIZES[0]) & (size < SIZES[1]) & whole]
    values = image.mean(axis=-1, dtype=np.float64)
    return Dots(np.array([_centre(values, *mark) for mark in marks]).reshape(-1, 2), diameter)


def dot_distance(flow: FlowArray, dots1: Dots, dots2: Dots) -> DotDistance | None:
    """Compares the dots of image 1, moved by the flow, with those of image 2; None if none stays in the image."""
    moved = moved_points(flow, dots1.centres)
    staying = moved[_inside(moved, flow.shape, dots1.diameter_px)]
    if not len(staying) or len(dots2.centres) < 2:
        return None
    distance, nearest = KDTree(dots2.centres).query(staying)
    closest = np.full(len(dots2.centres), np.inf)
    np.minimum.at(closest, nearest, distance)
    own = (distance < OWN_PITCHES * np.median(_nearest_other(dots2.centres))) & (distance == closest[nearest])
    return DotDistance(float(np.median(distance)), float(np.percentile(distance, 90)), float(own.sum() / len(moved)))


def _inside(points: PointArray, shape: tuple[int, ...], margin: float) -> NDArray[np.bool_]:
    """Whether points (N, 2) lie at least `margin` px from the border of an image of the shape (rows, columns, ...)."""
    last = np.array([shape[1], shape[0]]) - 1
    return np.asarray(((points >= margin) & (points <= last - margin)).all(axis=1))


def _nearest_other(points: PointArray) -> NDArray[np.float64]:
    """Distance (N,) px of each point to the nearest other."""
    return np.asarray(KDTree(points).query(points, 2)[0][:, 1])


def _marks(grey: Grey8, colour: int) -> NDArray[np.float64]:
    """Column, row and diameter, (N, 3) px, of convex marks darker (0) or brighter (255) than what surrounds them."""
    settings = cv2.SimpleBlobDetector.Params()
    settings.minThreshold, settings.maxThreshold, settings.thresholdStep = THRESHOLD_STEP, 255, THRESHOLD_STEP
    settings.minRepeatability, settings.minDistBetweenBlobs = 3, 4
    settings.blobColor = colour
    settings.minArea, settings.maxArea = 9, grey.size / 25
    settings.filterByCircularity, settings.minConvexity, settings.minInertiaRatio = False, 0.8, 0.15
    found = cv2.SimpleBlobDetector.create(settings).detect(grey)
    return np.array([(*mark.pt, mark.size) for mark in found], np.float64).reshape(-1, 3)


def _centre(values: NDArray[np.float64], column: float, row: float, diameter: float) -> NDArray[np.float64]:
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
