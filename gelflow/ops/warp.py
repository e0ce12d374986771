"""Backward warping: what image 1 should look like according to image 2 and a flow.

``warped(x) = image2(x + V(x))``, so that the true flow gives ``warped = image1``. Pixel (c, r) has its centre at
(c + 0.5, r + 0.5) and samples are bilinear between pixel centres. `torch.nn.functional.grid_sample` counts the same
way with ``align_corners=False``: its coordinate -1 is the image's left edge (0 px), +1 its right edge (W px).
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features, Flow, Mask
from gelflow.ops.spline import SplineImage


def pixel_indices(flow: Flow) -> tuple[Tensor, Tensor]:
    """Columns (1, 1, W) and rows (1, H, 1) of a flow's pixels, in its dtype, on its device."""
    height, width = flow.shape[-2:]
    columns = torch.arange(width, dtype=flow.dtype, device=flow.device).view(1, 1, width)
    rows = torch.arange(height, dtype=flow.dtype, device=flow.device).view(1, height, 1)
    return columns, rows


def positions(flow: Flow) -> tuple[Tensor, Tensor]:
    """Columns and rows x + flow(x) that each pixel is found at, (B, H, W) px from the centre of the first pixel."""
    columns, rows = pixel_indices(flow)
    return columns + flow[:, 0], rows + flow[:, 1]


def warp(image: Features, flow: Flow, mode: Literal["bilinear", "spline"] = "bilinear") -> Features:
    """Samples an image at x + flow(x); outside the image its border is repeated.

    In float32 the sampling position is rounded to about 1e-7 of the image's width (3e-5 px at 640 px). Where the flow
    is not finite the result is NaN; `grid_sample` itself would crash the process there, on a CPU, in its gradient.

    Args:
        image: The second image or its features, (B, C, H, W).
        flow: (B, 2, H, W), px of this image.
        mode: "bilinear", or "spline" (cubic, see `gelflow.ops.spline`), which overshoots at edges.

    Returns:
        (B, C, H, W), dtype of the flow.
    """
    height, width = flow.shape[-2:]
    x, y = positions(flow)
    finite = torch.isfinite(x) & torch.isfinite(y)
    # Far outside, the border is the border.
    x = torch.where(finite, x, 0.0).clamp(-width, 2 * width)
    y = torch.where(finite, y, 0.0).clamp(-height, 2 * height)
    if mode == "spline":
        sampled = SplineImage(image.to(flow.dtype)).at(x, y)
    else:
        grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
        sampled = F.grid_sample(image.to(flow.dtype), grid, padding_mode="border", align_corners=False)
    return sampled.masked_fill(~finite.unsqueeze(1), torch.nan)


def inside(flow: Flow) -> Mask:
    """1 where x + flow(x) lies between the pixel centres of the image, so that nothing is extrapolated; else 0.

    A flow of zero keeps every pixel, the border included. The mask carries no gradient.
    """
    height, width = flow.shape[-2:]
    x, y = positions(flow.detach())
    return ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).to(flow.dtype).unsqueeze(1)
