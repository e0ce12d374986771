"""What every lens model does, in the camera's own frame: x right, y down, z forward."""

from typing import Protocol

import numpy as np

from synth.arrays import FloatArray, Pixels, Points
from synth.optics.lens_fisheye import FisheyeLens
from synth.optics.lens_pinhole import PinholeLens
from synth.scene import Camera


class Lens(Protocol):
    """A map between directions and pixels, one-to-one within the lens's field, NaN beyond it."""

    @property
    def focal(self) -> FloatArray:
        """(fx, fy) px."""

    @property
    def centre(self) -> FloatArray:
        """(cx, cy) px; the centre of pixel (row r, column c) is (c + 0.5, r + 0.5)."""

    def project(self, local: Points) -> Pixels:
        """Pixels (n, 2) in which light from directions (n, 3) of any length arrives."""

    def directions(self, pixels: Pixels) -> Points:
        """Directions (n, 3), of any positive length, from which pixels (n, 2) get their light."""


def lens_of(camera: Camera) -> PinholeLens | FisheyeLens:
    """The lens of a camera."""
    kind = FisheyeLens if camera.lens == "fisheye" else PinholeLens
    return kind(np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy]), camera.distortion)
