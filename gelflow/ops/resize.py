"""Images and flows of another size."""

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Flow, Images


def resize_images(images: Images, size: tuple[int, int]) -> Images:
    """Images of another size: bilinear between pixel centres, low-pass filtered first where they shrink."""
    if (images.shape[-2], images.shape[-1]) == size:
        return images
    resized: Tensor = F.interpolate(images, size=size, mode="bilinear", align_corners=False, antialias=True)
    return resized


def resize_flow(flow: Flow, size: tuple[int, int]) -> Flow:
    """A flow for images of another size: bilinear between pixel centres, U and V each scaled with its own side.

    A pixel that touches a NaN of the given flow becomes NaN.
    """
    height, width = flow.shape[-2:]
    if (height, width) == size:
        return flow
    u, v = F.interpolate(flow, size=size, mode="bilinear", align_corners=False).unbind(dim=1)
    return torch.stack([u * (size[1] / width), v * (size[0] / height)], dim=1)
