"""Images and flows of another size, and at scales, by exact powers of two.

Scale s has ceil(H / 2^s) rows and ceil(W / 2^s) columns; its pixel (c, r) covers columns [2^s c, 2^s (c + 1)) of the
image, the last one possibly only in part. Lengths shrink by exactly 2^s, whatever H and W are, so no size needs to be
a multiple of anything. Flow is in px of its scale.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features, Flow, Images


def halve(image: Features) -> Features:
    """Mean of each 2x2 block; an odd last row or column is repeated first. (B, C, H, W) to half that, rounded up."""
    height, width = image.shape[-2:]
    padded = F.pad(image, (0, width % 2, 0, height % 2), mode="replicate") if height % 2 or width % 2 else image
    return F.avg_pool2d(padded, 2)


def image_pyramid(image: Features, scales: int) -> list[Features]:
    """The image at s = 0 .. scales-1, finest first."""
    pyramid = [image]
    for _ in range(scales - 1):
        pyramid.append(halve(pyramid[-1]))
    return pyramid


def halve_flow(flow: Flow) -> Flow:
    """Half the mean of the finite flows of each 2x2 block; NaN where fewer than half of the block are finite."""
    height, width = flow.shape[-2:]
    known = torch.isfinite(flow).all(dim=1, keepdim=True)
    both = torch.cat([torch.where(known, flow, 0.0), known.to(flow.dtype)], dim=1)
    both = F.avg_pool2d(F.pad(both, (0, width % 2, 0, height % 2)), 2)
    total, share = both[:, :2], both[:, 2:]
    inside = F.avg_pool2d(F.pad(torch.ones_like(flow[:, :1]), (0, width % 2, 0, height % 2)), 2)
    mean = total / share.clamp(min=0.25)
    return torch.where(share >= 0.5 * inside, 0.5 * mean, torch.nan)


def flow_pyramid(flow: Flow, scales: int) -> list[Flow]:
    """A true flow (NaN where unknown) at s = 0 .. scales-1, finest first, each in px of its scale."""
    pyramid = [flow]
    for _ in range(scales - 1):
        pyramid.append(halve_flow(pyramid[-1]))
    return pyramid


def enlarge_flow(flow: Flow, octaves: int, size: tuple[int, int]) -> Flow:
    """A flow brought to a finer scale: bilinear between pixel centres, values times 2^octaves, cropped to size.

    The finer scale has at most 2^octaves times the rows and columns.
    """
    factor = 2**octaves
    finer: Tensor = F.interpolate(flow, scale_factor=float(factor), mode="bilinear", align_corners=False)
    return factor * finer[..., : size[0], : size[1]]


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
