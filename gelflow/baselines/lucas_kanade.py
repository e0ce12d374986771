"""Sparse pyramidal Lucas-Kanade tracking (Bouguet 2001), interpolated to a dense flow.

Corners of Shi and Tomasi (at most 2000, at least 5 px apart, of 1 % or more of the best corner's quality) are tracked
by OpenCV with windows of 21 px over 5 octaves, there and back. Points that do not come back to within 0.5 px are
dropped; the others are interpolated as in `gelflow.baselines.scattered`. 8-bit luma.
"""

import cv2
import numpy as np

from gelflow.arrays import FlowArray, ImageArray
from gelflow.baselines.scattered import dense_flow
from gelflow.errors import NothingFoundError
from gelflow.files.image import check_images, to_grey
from gelflow.methods.name import MethodName

CORNERS, QUALITY, DISTANCE_PX = 2000, 0.01, 5.0
WINDOW_PX, OCTAVES = 21, 4
CLOSURE_PX = 0.5
"""Largest distance between a point and where its track there and back ends."""


class LucasKanade:
    """Tracks corners and interpolates their motion."""

    name = MethodName("Lucas-Kanade")

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`.

        Raises:
            NothingFoundError: Nothing can be tracked: no corner, or none that is found again.
            InputError: See `check_images`.
        """
        check_images(image1, image2)
        first, second = to_grey(image1), to_grey(image2)
        start = cv2.goodFeaturesToTrack(first, CORNERS, QUALITY, DISTANCE_PX)
        if start is None:
            raise NothingFoundError("image 1 has no corner that Lucas-Kanade could track; leave this method out")
        options = {
            "winSize": (WINDOW_PX, WINDOW_PX),
            "maxLevel": OCTAVES,
            "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.001),
        }
        there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **options)
        back, found_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, **options)
        closure = np.linalg.norm(back - start, axis=-1).ravel()
        kept = (found.ravel() > 0) & (found_back.ravel() > 0) & (closure < CLOSURE_PX)
        if not kept.any():
            raise NothingFoundError("Lucas-Kanade found none of image 1's corners in image 2; leave this method out")
        points = start.reshape(-1, 2)[kept].astype(np.float64)
        motion = there.reshape(-1, 2)[kept].astype(np.float64) - points
        return dense_flow(points, motion, *first.shape)
