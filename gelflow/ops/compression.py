"""Compression of single images by quantised block transforms, as in JPEG, MPEG-4 and H.263.

Luma and, at half the resolution, chroma are cut into blocks of 8 px. The coefficients of a block's cosine transform are
rounded to multiples of one step (G. K. Wallace, The JPEG still picture compression standard, 1991).
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Images
from gelflow.ops.cached import cached

BLOCK_PX = 8
COLOURS = ((0.299, 0.587, 0.114), (-0.1687, -0.3313, 0.5), (0.5, -0.4187, -0.0813))
"""Luma and two chroma components of red, green and blue (ITU-R BT.601)."""


def compressed(images: Images, steps: Tensor) -> Images:
    """Images (B, 3, H, W) in [0, 1], quantised with steps (B,) in units of white; a step of 0 changes nothing."""
    height, width = images.shape[-2:]
    to_luma, to_colours = _colour_matrices(images.device, images.dtype)
    luma, chroma = torch.einsum("ij,bjhw->bihw", to_luma, images).split([1, 2], dim=1)
    luma = _quantised(luma, steps)
    chroma = _quantised(F.avg_pool2d(chroma, 2, ceil_mode=True), steps)
    chroma = F.interpolate(chroma, scale_factor=2, mode="nearest")[..., :height, :width]
    found = torch.einsum("ij,bjhw->bihw", to_colours, torch.cat([luma, chroma], dim=1))
    return torch.where(steps.view(-1, 1, 1, 1) > 0, found.clamp(0, 1), images)


def _quantised(images: Images, steps: Tensor) -> Images:
    """Images (B, C, H, W) whose blocks' cosine transforms are multiples of the steps."""
    height, width = images.shape[-2:]
    padded = F.pad(images, (0, -width % BLOCK_PX, 0, -height % BLOCK_PX), mode="replicate")
    blocks = padded.unflatten(-1, (-1, BLOCK_PX)).unflatten(-3, (-1, BLOCK_PX))
    transform = _cosines(images.device, images.dtype)
    coefficients = torch.einsum("ij,bchjwk,lk->bchiwl", transform, blocks, transform)
    step = steps.clamp(min=1e-6).view(-1, 1, 1, 1, 1, 1)
    coefficients = (coefficients / step).round() * step
    blocks = torch.einsum("ij,bchiwl,lk->bchjwk", transform, coefficients, transform)
    return blocks.flatten(-2).flatten(-3, -2)[..., :height, :width]


@cached
def _colour_matrices(device: torch.device, dtype: torch.dtype) -> Tensor:
    """COLOURS and its inverse, (2, 3, 3)."""
    matrix = torch.tensor(COLOURS, dtype=torch.float64)
    return torch.stack([matrix, matrix.inverse()]).to(device, dtype)


@cached
def _cosines(device: torch.device, dtype: torch.dtype) -> Tensor:
    """The orthonormal cosine transform (DCT-II) of a block's row, (8, 8)."""
    position = torch.arange(BLOCK_PX, dtype=torch.float64)
    waves = torch.cos(math.pi / BLOCK_PX * position[:, None] * (position + 0.5)) * math.sqrt(2 / BLOCK_PX)
    return torch.cat([waves[:1] / math.sqrt(2), waves[1:]]).to(device, dtype)
