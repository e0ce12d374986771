"""The classical methods that the paper compares with, as OpenCV has them, on 8-bit luma.

- Farnebäck 2003, polynomial expansion: pyramid 1/2 with 5 levels, window 15, 5 iterations, neighbourhood 7, sigma 1.5.
  (The paper does not give its parameters; these are OpenCV's customary window with its larger neighbourhood.)
- DIS, Kroeger et al. 2016: the presets ultrafast, fast and medium.
- TV-L1, Zach, Pock and Bischof 2007: OpenCV's defaults (tau .25, lambda .15, theta .3, 5 scales, 5 warps).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gelflow.arrays import FlowArray, ImageArray
from gelflow.baselines.method import check_images
from gelflow.errors import InputError
from gelflow.files.image import to_grey


@dataclass(frozen=True)
class NoMotion:
    """Says that nothing moved: what every method has to beat."""

    name: str = "no motion"

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """A flow of zero everywhere."""
        check_images(image1, image2)
        return np.zeros((*image1.shape[:2], 2), np.float32)


@dataclass(frozen=True)
class Farneback:
    """Farnebäck's polynomial expansion."""

    name: str = "Farnebäck"

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        import cv2

        check_images(image1, image2)
        start = np.zeros((*image1.shape[:2], 2), np.float32)
        return np.asarray(
            cv2.calcOpticalFlowFarneback(
                to_grey(image1), to_grey(image2), start,
                pyr_scale=0.5, levels=5, winsize=15, iterations=5, poly_n=7, poly_sigma=1.5, flags=0,
            )
        )  # fmt: skip


@dataclass(frozen=True)
class DIS:
    """Dense inverse search with one of OpenCV's presets."""

    preset: Literal["ultrafast", "fast", "medium"]

    @property
    def name(self) -> str:
        """Name in tables."""
        return f"DIS {self.preset}"

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        import cv2

        check_images(image1, image2)
        preset = {
            "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
            "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
            "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
        }[self.preset]
        try:
            return np.asarray(cv2.DISOpticalFlow.create(preset).calc(to_grey(image1), to_grey(image2), None))
        except cv2.error as error:
            size = f"{image1.shape[1]} x {image1.shape[0]} px"
            raise InputError(f"{self.name} cannot work on images of {size}: {error.err}") from error


@dataclass(frozen=True)
class TVL1:
    """Total variation and L1 data term (duality based)."""

    name: str = "TV-L1"

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        import cv2

        check_images(image1, image2)
        if not hasattr(cv2, "optflow"):
            raise InputError(
                "TV-L1 needs opencv-contrib, and another OpenCV package hides it; "
                "pip install --force-reinstall opencv-contrib-python-headless"
            )
        method = cv2.optflow.DualTVL1OpticalFlow.create()
        return np.asarray(method.calc(to_grey(image1), to_grey(image2), None))
