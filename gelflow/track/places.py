"""Markers in millimetres on the gel's face, by a scene's own optics.

`synth preview --places` writes where each pixel of a scene's camera sees the gel at rest. A marker's place and motion
are read there, at its pixels before and after; that the gel under it has moved toward the camera is not known here.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import FlowArray
from gelflow.errors import InputError
from gelflow.files.exr import read_channels

MILLIMETRES = ("id", "frame", "time_s", "x_mm", "y_mm", "u_mm", "v_mm", "sigma_mm", "visible")
"""Columns in place of `gelflow.track.markers.COLUMNS`."""


def read_places(path: Path | None, markers: bool) -> FlowArray | None:
    """X and Y of the gel at rest (H, W, 2), mm, NaN where there is none; InputError for another file, or no markers."""
    if path is None:
        return None
    if not markers:
        raise InputError("--scene: is for --markers, whose numbers are then in mm; give both")
    planes = read_channels(path)
    if not {"place.X", "place.Y"} <= set(planes):
        raise InputError(f"{path}: has no channels place.X and place.Y; write it by synth preview --places {path.name}")
    return np.stack([planes["place.X"], planes["place.Y"]], axis=-1)


def in_millimetres(markers: NDArray[np.void], places: FlowArray) -> NDArray[np.void]:
    """Markers whose x, y, u, v and sigma are in mm; NaN where no gel is seen."""

    def at(x: NDArray[Any], y: NDArray[Any]) -> FlowArray:
        return cv2.remap(places, x - 0.5, y - 0.5, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, (np.nan, np.nan))[:, 0]

    found, x, y = markers.copy(), markers["x"], markers["y"]
    slopes = np.stack([at(x + 0.5, y) - at(x - 0.5, y), at(x, y + 0.5) - at(x, y - 0.5)], axis=-1)
    found["x"], found["y"] = at(x, y).T
    found["u"], found["v"] = (at(x + markers["u"], y + markers["v"]) - at(x, y)).T
    found["sigma"] *= np.sqrt(np.abs(np.linalg.det(slopes)))
    return found
