"""Markers: dots, blobs or pins of the reference, moved by the flow. No grid is assumed, and none is fitted.

Each marker is read from the flow at its own centre, so that a missing or broken one disturbs no other. It is visible
where it stays in the image, sigma is known, the two images resemble each other in a window of its own size, and no
surer marker is at the same place.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from gelflow.arrays import Estimate, FlowArray, ImageArray, MapArray
from gelflow.fast.registration import indices, resized
from gelflow.files.image import to_grey
from gelflow.models.working_size import unknown_px
from gelflow.ops.blobs import SIZES, blob_centre, blobs, inside_by
from gelflow.track.places import MILLIMETRES, in_millimetres

MARKERS = np.dtype(
    [("id", np.int32), *((name, np.float32) for name in ("x", "y", "u", "v", "sigma")), ("visible", np.bool_)]
)
"""A marker: its number, its centre in the reference (pixel centres are at (c + 0.5, r + 0.5)), its motion since, the
sigma of the flow there, all px, and whether it is seen."""
MIN_LIKENESS = 0.4
"""Correlation of a marker's surroundings in the two images below which it is not seen."""
COLUMNS = ("id", "frame", "time_s", "x", "y", "u", "v", "sigma", "visible")


class Markers:
    """The markers of a reference image (H, W, 3) in [0, 1], as long as it is the reference."""

    def __init__(self, reference: ImageArray) -> None:
        grey, values = to_grey(reference), reference.mean(axis=-1, dtype=np.float64)
        found = blobs(grey)
        if len(found):
            size = found[:, 2] / np.median(found[:, 2])
            whole = inside_by(found[:, :2], grey.shape, 0.6 * float(np.median(found[:, 2])))
            found = found[(size > SIZES[0]) & (size < SIZES[1]) & whole]
        self._half = (grey.shape[0] // 2, grey.shape[1] // 2)
        self._reference = resized(cv2.cvtColor(reference, cv2.COLOR_RGB2GRAY), self._half)
        self._deviation = float(np.median(found[:, 2])) / 2 if len(found) else 1.0
        self._centres = np.array([blob_centre(values, *blob) for blob in found]).reshape(-1, 2)

    def __len__(self) -> int:
        return len(self._centres)

    def at(self, found: Estimate, frame: ImageArray) -> NDArray[np.void]:
        """All markers, (N,) of `MARKERS`, under the flow from the reference to a frame."""
        centres = self._centres.astype(np.float32).reshape(1, -1, 2)

        def read(field: MapArray) -> NDArray[np.float32]:
            return cv2.remap(field, centres, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]

        markers = np.zeros(len(self), MARKERS)
        if not len(self):
            return markers
        markers["id"] = np.arange(len(self))
        markers["x"], markers["y"] = (self._centres + 0.5).T
        markers["u"], markers["v"] = read(found.flow).T
        markers["sigma"] = read(found.sigma)
        likeness = resized(self._likeness(found.flow, frame), found.sigma.shape)
        known = markers["sigma"] < unknown_px(*found.sigma.shape)
        markers["visible"] = known & (read(found.visible) > 0.5) & (read(likeness) > MIN_LIKENESS)
        ends = np.nan_to_num(np.stack([markers["x"] + markers["u"], markers["y"] + markers["v"]], axis=-1))
        for pair in KDTree(ends).query_pairs(self._deviation):
            markers["visible"][max(pair, key=lambda one: markers["sigma"][one])] = False
        return markers

    def _likeness(self, flow: FlowArray, frame: ImageArray) -> MapArray:
        """Of reference and moved frame, covariance over the mean of the variances, at half their size; at most 1."""
        one, other = self._reference, resized(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY), self._half)
        places = indices(*self._half) + resized(np.nan_to_num(flow), self._half) / 2
        two = cv2.remap(other, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        fields = (one, two, one * two, one * one + two * two)
        mean1, mean2, mixed, square = (cv2.GaussianBlur(field, (0, 0), self._deviation / 2) for field in fields)
        return 2 * (mixed - mean1 * mean2) / (square - mean1**2 - mean2**2).clip(1e-9)


def marker_table(places: FlowArray | None) -> Sequence[str]:
    """The columns of a table of markers, whose numbers are in mm where places are known."""
    return COLUMNS if places is None else MILLIMETRES


def marker_rows(
    frame: int, time_s: float | None, markers: NDArray[np.void], places: FlowArray | None = None
) -> Iterator[tuple[Any, ...]]:
    """The rows of such a table for the markers of one frame."""
    for marker in markers if places is None else in_millimetres(markers, places):
        numbers = (round(float(marker[name]), 4) for name in COLUMNS[3:-1])
        yield marker["id"], frame, time_s, *numbers, int(marker["visible"])
