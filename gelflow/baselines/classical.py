"""The classical methods that the paper compares with, as OpenCV has them, on 8-bit luma.

- Farnebäck 2003, polynomial expansion: pyramid 1/2 with 5 levels, window 15, 5 iterations, neighbourhood 7, sigma 1.5.
  (The paper does not give its parameters; these are OpenCV's customary window with its larger neighbourhood.)
- DIS, Kroeger et al. 2016: the presets ultrafast, fast and medium.
- TV-L1, Zach, Pock and Bischof 2007: OpenCV's defaults (tau .25, lambda .15, theta .3, 5 scales, 5 warps).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import cv2
import numpy as np

from gelflow.arrays import FlowArray, Grey8, ImageArray
from gelflow.config import RegistrationConfig
from gelflow.errors import InputError
from gelflow.fast import start
from gelflow.files.image import check_images, to_grey
from gelflow.methods.method import as_array, as_tensor
from gelflow.methods.name import MethodName
from gelflow.models.registration import registered


@dataclass(frozen=True)
class Classical:
    """A method that estimates the flow (H, W, 2) of two grey images."""

    name: MethodName
    estimate: Callable[[Grey8, Grey8], Any]

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        check_images(image1, image2)
        try:
            return np.asarray(self.estimate(to_grey(image1), to_grey(image2)))
        except cv2.error as error:
            size = f"{image1.shape[1]} x {image1.shape[0]} px"
            raise InputError(f"{self.name} cannot work on images of {size}: {error.err}") from error


def dis(preset: Literal["ultrafast", "fast", "medium"]) -> Classical:
    """Dense inverse search with one of OpenCV's presets."""
    return Classical(MethodName(f"DIS {preset}"), partial(start.dis, preset))


def _still(grey1: Grey8, grey2: Grey8) -> FlowArray:
    return np.zeros((*grey1.shape, 2), np.float32)


def _farneback(grey1: Grey8, grey2: Grey8) -> Any:
    settings = {"pyr_scale": 0.5, "levels": 5, "winsize": 15, "iterations": 5, "poly_n": 7, "poly_sigma": 1.5}
    return cv2.calcOpticalFlowFarneback(grey1, grey2, _still(grey1, grey2), **settings, flags=0)


def _tvl1(grey1: Grey8, grey2: Grey8) -> Any:
    if not hasattr(cv2, "optflow"):
        raise InputError(
            "TV-L1 needs opencv-contrib, and another OpenCV package hides it; "
            "pip install --force-reinstall opencv-contrib-python-headless"
        )
    return cv2.optflow.DualTVL1OpticalFlow.create().calc(grey1, grey2, None)


NO_MOTION = Classical(MethodName("no motion"), _still)
"""Says that nothing moved: what every method has to beat."""
FARNEBACK = Classical(MethodName("Farnebäck"), _farneback)
TVL1 = Classical(MethodName("TV-L1"), _tvl1)


@dataclass(frozen=True)
class RegisteredDIS:
    """DIS medium on the processor, then registration, on a device, at the images' own size. Not one of the paper's.

    Registration (`gelflow.models.registration`) learns nothing and starts from any flow. What it adds to a network has
    to be compared with what it adds to the best classical method.
    """

    aim: str
    settings: RegistrationConfig
    device: str = "cpu"

    @property
    def name(self) -> MethodName:
        return MethodName("DIS medium", registration=self.aim)

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        begin = dis("medium").flow(image1, image2)
        first, second = as_tensor(image1, self.device), as_tensor(image2, self.device)
        return as_array(registered(as_tensor(begin, self.device), first, second, self.settings))
