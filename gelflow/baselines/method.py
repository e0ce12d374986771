"""The interface of everything that estimates flow."""

from typing import Protocol

import numpy as np

from gelflow.arrays import FlowArray, ImageArray
from gelflow.errors import InputError
from gelflow.files.image import MINIMUM_SIDE


class Method(Protocol):
    """Estimates the flow from image 1 to image 2: ``I1(x) = I2(x + flow(x))``."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """Flow (H, W, 2) float32 in px of two images (H, W, 3) float32 in [0, 1].

        Raises:
            InputError: The images differ in shape, are too small, or hold values that are not finite.
        """
        ...


def check_images(image1: ImageArray, image2: ImageArray) -> None:
    """Refuses images that differ in shape, are not (H, W, 3), are too small, or hold values that are not finite."""
    for name, image in (("image 1", image1), ("image 2", image2)):
        if image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"{name} has shape {image.shape}; (rows, columns, 3) is needed, a grey image repeated")
        if min(image.shape[:2]) < MINIMUM_SIDE:
            raise InputError(f"{name} has {image.shape[1]} x {image.shape[0]} px; each side needs {MINIMUM_SIDE} px")
        if not np.isfinite(image).all():
            raise InputError(f"{name} holds NaN or infinite values; values in [0, 1] are needed")
    if image1.shape != image2.shape:
        raise InputError(f"image 1 has shape {image1.shape} and image 2 {image2.shape}; they must be equal")
