"""The answer itself as a method."""

import numpy as np

from gelflow.arrays import FlowArray, ImageArray
from gelflow.errors import InputError
from gelflow.files.exr import FlowField
from gelflow.methods.name import MethodName


class ExactFlow:
    """The data set's own exact flow as a row of the comparison: what PSNR and SSIM say of the truth.

    Its endpoint error is zero by definition. Neither is its PSNR infinite nor its SSIM 1: image 2 has noise and shading
    of its own, and hides a part of image 1. A method with a higher PSNR has followed those, too, not the gel alone.
    """

    name = MethodName("exact flow")

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """Always raises InputError: images alone do not tell."""
        raise InputError("the exact flow cannot be estimated from images; it is a row of `compare` on synthetic pairs")

    def of(self, truth: FlowField | None) -> FlowArray:
        """The true flow (H, W, 2) px, zero where no gel is seen; InputError where the pair has none."""
        if truth is None:
            raise InputError("the pair has no exact flow; leave the method exact out")
        return np.nan_to_num(truth.flow)
