"""Local correlation, the cost volume of PWC-Net (Sun et al. 2018, eq. 3), as a mean over channels.

``c(x, d) = 1/C sum_k f1_k(x) f2_k(x + d)`` for all displacements d with |d_x|, |d_y| <= r; features beyond the border
are zero. Displacements are ordered row by row: channel (d_y + r)(2 r + 1) + (d_x + r).
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from gelflow.arrays import Features

MANY_CHANNELS = 100
"""Pixels for each channel below which blocks are faster than channels."""
ROWS, BLOCK = 30, 20
"""Rows of a strip, and columns of a block."""


class _LocalCorrelation(torch.autograd.Function):
    """Through small buffers; autograd itself would hold all (2 r + 1)^2 products."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor, radius: int) -> Tensor:
        ctx.save_for_backward(first, second)
        ctx.radius = radius
        channels, height, width = first.shape[1:]
        if first.is_cuda:  # three launches, and memory for all products
            side = 2 * radius + 1
            windows = F.pad(second, (radius,) * 4).unfold(2, side, 1).unfold(3, side, 1)
            return (first[..., None, None] * windows).mean(dim=1).flatten(3).permute(0, 3, 1, 2).contiguous()
        if MANY_CHANNELS * channels < height * width:
            return _by_channels(first, second, radius)
        return _by_blocks(first, second, radius)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor, None]:
        first, second = ctx.saved_tensors
        radius = ctx.radius
        channels, height, width = first.shape[1:]
        padded = F.pad(second, (radius,) * 4)
        of_first, of_padded = torch.zeros_like(first), torch.zeros_like(padded)
        gradient = gradient / channels
        for channel, (rows, columns) in enumerate(_windows(height, width, radius)):
            cost = gradient[:, channel : channel + 1]
            of_first.addcmul_(padded[:, :, rows, columns], cost)
            of_padded[:, :, rows, columns].addcmul_(first, cost)
        return of_first, of_padded[:, :, radius : radius + height, radius : radius + width], None


def _windows(height: int, width: int, radius: int) -> list[tuple[slice, slice]]:
    side = range(2 * radius + 1)
    return [(slice(row, row + height), slice(column, column + width)) for row in side for column in side]


def local_correlation(first: Features, second: Features, radius: int) -> Tensor:
    """Mean over channels of the products of each pixel's features with those of its neighbours in the other image.

    It is (B, (2 r + 1)^2, H, W), and differentiable once.
    """
    if torch.compiler.is_exporting() or torch.onnx.is_in_onnx_export():
        return _unfolded(first, second, radius)
    costs: Tensor = _LocalCorrelation.apply(first.contiguous(), second.contiguous(), radius)
    return costs


def _by_channels(first: Tensor, second: Tensor, radius: int) -> Tensor:
    """Channel by channel, in strips of rows that stay in a processor's cache."""
    batch, channels, height, width = first.shape
    side = 2 * radius + 1
    first, costs = first / channels, first.new_empty(batch, side, side, height, width)
    windows = F.pad(second, (radius,) * 4).unfold(2, height, 1).unfold(3, width, 1)
    for top in range(0, height, ROWS):
        strip = costs[..., top : top + ROWS, :].zero_()
        for here, there in zip(first[..., top : top + ROWS, :].unbind(1), windows.unbind(1), strict=True):
            strip.addcmul_(here[:, None, None], there[..., top : top + ROWS, :])
    return costs.flatten(1, 2)


def _by_blocks(first: Tensor, second: Tensor, radius: int) -> Tensor:
    """Blocks of pixels of a row against a row of the other image, as matrices."""
    batch, channels, height, width = first.shape
    side, blocks, reach = 2 * radius + 1, -(-width // BLOCK), BLOCK + 2 * radius
    beyond = blocks * BLOCK - width
    here = F.pad(first / channels, (0, beyond)).permute(0, 2, 3, 1).reshape(-1, BLOCK, channels)
    there = F.pad(second, (radius, radius + beyond, radius, radius)).unfold(3, reach, BLOCK)
    there = there.permute(0, 2, 3, 1, 4).contiguous()
    costs = first.new_empty(batch, side, side, height, blocks * BLOCK)
    for row in range(side):
        with torch.autocast("cpu", enabled=False):
            products = here @ there[:, row : row + height].reshape(-1, channels, reach)
        # Each pixel's own 2 r + 1 of the block's products lie one further than those of the pixel before.
        own = products.as_strided((len(products), side, BLOCK), (BLOCK * reach, 1, reach + 1))
        costs[:, row] = own.view(batch, height, blocks, side, BLOCK).permute(0, 3, 1, 2, 4).flatten(3)
    return costs[..., :width].flatten(1, 2)


def _unfolded(first: Tensor, second: Tensor, radius: int) -> Tensor:
    """The same in operations that an exported graph can hold, with (2 r + 1)^2 times the memory."""
    batch, channels, height, width = first.shape
    side = 2 * radius + 1
    windows = F.unfold(second, side, padding=radius).view(batch, channels, side * side, height, width)
    return (first.unsqueeze(2) * windows).mean(dim=1)
