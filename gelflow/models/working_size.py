"""The two sizes at which large images are worked on; `gelflow.models.estimate` chooses between their flows.

Most gels that the shipped network learned from have images of 320 x 240 px. In larger ones it may take dots for their
neighbours, and what is between dots is beyond the windows of registration and uncertainty, which are in px. Reduced
images show such patterns better, and fine ones worse.
"""

import math

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.config import MINIMUM_SIDE
from gelflow.models.uncertainty import MAX_SIGMA_PX, UNKNOWN_PX, flow_sigma
from gelflow.ops.pyramid import resize_flow, resize_images

LARGE = 400 * 300
"""Images of no more pixels are worked on at their own size alone."""
MOST, LEAST = 640 * 480, 320 * 240
"""Pixels of the two sizes; the first at most those of the image."""


def working_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """Rows and columns of one or two sizes for images of that size; the network's least where they are smaller."""
    pixels, enlarged = height * width, max(1.0, MINIMUM_SIDE / min(height, width))
    least = [(round(enlarged * height), round(enlarged * width))]
    if pixels <= LARGE:
        return least
    scales = (min(1.0, math.sqrt(limit / pixels)) for limit in (MOST, LEAST))
    sizes = [(round(scale * height), round(scale * width)) for scale in scales]
    return [size for size in sizes if min(size) >= MINIMUM_SIDE] or least


def unknown_px(height: int, width: int) -> float:
    """The sigma above which a flow counts as unknown: `UNKNOWN_PX`, in larger images than LARGE as if reduced to it."""
    return UNKNOWN_PX * max(1.0, math.sqrt(height * width / LARGE))


def sized_sigma(flow: Flow, image1: Images, image2: Images, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """`flow_sigma`, computed on images reduced to a size; arguments, results and px are those of the images."""
    native, known = (flow.shape[-2], flow.shape[-1]), flow.isfinite().all(dim=1, keepdim=True)
    maps = flow_sigma(resize_flow(flow, size), resize_images(image1, size), resize_images(image2, size))
    sigma, visible = (resize_images(each, native) for each in maps)
    sigma = torch.where(known, sigma * math.sqrt(math.prod(native) / math.prod(size)), MAX_SIGMA_PX)
    return sigma.clamp(max=MAX_SIGMA_PX), known * visible
