"""RAFT's all-pairs correlation and its lookup (Teed and Deng 2020, section 3.2).

``C(x, y) = <f1(x), f2(y)> / sqrt(channels)`` for every pixel x of image 1 and y of image 2, at four resolutions of
image 2: level k is the mean over blocks of 2^k x 2^k pixels y. The lookup reads C(x, .) bilinearly on a grid of
(2 r + 1)^2 unit steps of each level around the point that x has moved to; outside the image it reads zero.

Two conventions that the published weights were trained with, and that differ from the rest of gelflow:

- Positions are pixel *indices* at every level: index i of level 0 is read at index i / 2^k of level k, although the
  centre of its block lies at (i + 1/2) / 2^k - 1/2.
- Displacements are ordered column by column: channel (d_x + r)(2 r + 1) + (d_y + r).
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features, Flow

LEVELS = 4
"""Resolutions of the correlation."""


def correlation_pyramid(first: Features, second: Features) -> list[Tensor]:
    """All-pairs correlation at `LEVELS` resolutions of the second image, (B H W, 1, H // 2^k, W // 2^k) at level k.

    H and W are at least 8, so that every level has a pixel.
    """
    batch, channels, height, width = first.shape
    product = torch.einsum("bcn,bcm->bnm", first.flatten(2), second.flatten(2)) / channels**0.5
    levels = [product.reshape(batch * height * width, 1, height, width)]
    for _ in range(LEVELS - 1):
        levels.append(F.avg_pool2d(levels[-1], 2))
    return levels


def lookup(pyramid: list[Tensor], position: Flow, radius: int) -> Features:
    """Correlation around given positions.

    Args:
        pyramid: As `correlation_pyramid` gives it.
        position: Where each pixel of image 1 is in image 2, (B, 2, H, W), (column, row) as indices.
        radius: r, px of each level.

    Returns:
        (B, LEVELS (2 r + 1)^2, H, W), finest level first.
    """
    batch, _, height, width = position.shape
    side = 2 * radius + 1
    step = torch.arange(-radius, radius + 1, dtype=position.dtype, device=position.device)
    across, down = torch.meshgrid(step, step, indexing="ij")
    window = torch.stack([across, down], dim=-1)
    centre = position.permute(0, 2, 3, 1).reshape(batch * height * width, 1, 1, 2)
    found = []
    for level, costs in enumerate(pyramid):
        size = costs.new_tensor([costs.shape[-1], costs.shape[-2]])
        # An index i is at (2 i + 1) / size - 1 in grid_sample's coordinates, with align_corners=False.
        place = (2 * (centre / 2**level + window) + 1) / size - 1
        values = F.grid_sample(costs, place, mode="bilinear", padding_mode="zeros", align_corners=False)
        found.append(values.view(batch, height, width, side * side))
    return torch.cat(found, dim=-1).permute(0, 3, 1, 2).contiguous()
