"""Dots found in both images of a pair: how near to them a flow leads, with nothing tracked and no exact flow.

Marks are found in each image alone, dark or bright, whichever are more: blobs that stand out at several thresholds
(OpenCV's `SimpleBlobDetector`). They are a pattern of dots where there are enough of them, of about one size and about
equally far from the nearest other; the grains of speckle are not. A dot's centre is the centroid of its darkness (or
brightness) against a plane fitted to a ring around it.

A dot of image 1 is moved by the flow and compared with the nearest dot of image 2. The distance does not tell which of
the dots that is: a flow that is wrong by a whole pitch of the pattern leads to dots, too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from gelflow.arrays import FlowArray, ImageArray, PointArray
from gelflow.compare.metrics import moved_points
from gelflow.files.image import to_grey
from gelflow.ops.blobs import SIZES, blob_centre, blobs, inside_by

FEWEST = 12
"""Dots that make a pattern."""
MAX_SPREAD = 0.09
"""Largest spread of the dots' diameters in a pattern, and of their distances to the nearest other: median deviation
from the median, as a share of it."""
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
    marks = blobs(grey)
    if len(marks) < FEWEST:
        return None
    size, apart = marks[:, 2] / np.median(marks[:, 2]), _nearest_other(marks[:, :2])
    if max(np.median(np.abs(size - 1)), np.median(np.abs(apart / np.median(apart) - 1))) > MAX_SPREAD:
        return None
    diameter = float(np.median(marks[:, 2]))
    whole = inside_by(marks[:, :2], grey.shape, 0.6 * diameter)
    marks = marks[(size > SIZES[0]) & (size < SIZES[1]) & whole]
    values = image.mean(axis=-1, dtype=np.float64)
    return Dots(np.array([blob_centre(values, *mark) for mark in marks]).reshape(-1, 2), diameter)


def dot_distance(flow: FlowArray, dots1: Dots, dots2: Dots) -> DotDistance | None:
    """Compares the dots of image 1, moved by the flow, with those of image 2; None if none stays in the image."""
    moved = moved_points(flow, dots1.centres)
    staying = moved[inside_by(moved, flow.shape, dots1.diameter_px)]
    if not len(staying) or len(dots2.centres) < 2:
        return None
    distance, nearest = KDTree(dots2.centres).query(staying)
    closest = np.full(len(dots2.centres), np.inf)
    np.minimum.at(closest, nearest, distance)
    own = (distance < OWN_PITCHES * np.median(_nearest_other(dots2.centres))) & (distance == closest[nearest])
    return DotDistance(float(np.median(distance)), float(np.percentile(distance, 90)), float(own.sum() / len(moved)))


def _nearest_other(points: PointArray) -> NDArray[np.float64]:
    """Distance (N,) px of each point to the nearest other."""
    return np.asarray(KDTree(points).query(points, 2)[0][:, 1])
