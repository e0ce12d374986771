"""Backward warping: what image 1 should look like according to image 2 and a flow.

``warped(x) = image2(x + V(x))``, so that the true flow gives ``warped = image1``. Pixel (c, r) has its centre at
(c + 0.5, r + 0.5) and samples are bilinear between pixel centres. `torch.nn.functional.grid_sample` counts the same
way with ``align_corners=False``: its coordinate -1 is the image's left edge (0 px), +1 its right edge (W px).
"""

from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features, Flow, FlowArray, ImageArray, Mask
from gelflow.ops.cached import cached
from gelflow.ops.spline import SplineImage


def pixel_indices(like: Tensor) -> Tensor:
    """Column and row of each pixel of a (..., H, W): (2, H, W), in its dtype, on its device, not to be changed."""
    height, width = like.shape[-2:]
    return _pixel_indices(height, width, like.dtype, like.device)


@cached
def _pixel_indices(height: int, width: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    sides = (torch.arange(side, dtype=dtype, device=device) for side in (height, width))
    rows, columns = torch.meshgrid(*sides, indexing="ij")
    return torch.stack([columns, rows])


def from_centre(like: Tensor) -> Tensor:
    """Column and row of each pixel of a (..., H, W), from the image's centre: (2, H, W) px."""
    height, width = like.shape[-2:]
    columns, rows = pixel_indices(like)
    return torch.stack([columns - (width - 1) / 2, rows - (height - 1) / 2])


def positions(flow: Flow) -> Tensor:
    """Where each pixel is found: column and row x + flow(x), (B, 2, H, W) px from the centre of the first pixel."""
    return flow + pixel_indices(flow)


def warp(image: Features, flow: Flow, mode: Literal["bilinear", "spline"] = "bilinear") -> Features:
    """Samples an image at x + flow(x); outside the image its border is repeated.

    In float32 the sampling position is rounded to about 1e-7 of the image's width (3e-5 px at 640 px). Where the flow
    is not finite the result is NaN; `grid_sample` itself would crash the process there, on a CPU, in its gradient.

    The image, or its features, is (B, C, H, W), and so is the result, in the flow's dtype; the flow is (B, 2, H, W), px
    of this image. Mode "spline" (cubic, see `gelflow.ops.spline`) overshoots at edges.
    """
    height, width = flow.shape[-2:]
    x, y = positions(flow).unbind(dim=1)
    finite = torch.isfinite(x) & torch.isfinite(y)
    # Far outside, the border is the border.
    x = torch.where(finite, x, 0.0).clamp(-width, 2 * width)
    y = torch.where(finite, y, 0.0).clamp(-height, 2 * height)
    if mode == "spline":
        sampled = SplineImage(image.to(flow.dtype)).at(torch.stack([x, y], dim=1))
    else:
        grid = torch.stack([(2 * x + 1) / width - 1, (2 * y + 1) / height - 1], dim=-1)
        sampled = F.grid_sample(image.to(flow.dtype), grid, padding_mode="border", align_corners=False)
    return sampled.masked_fill(~finite.unsqueeze(1), torch.nan)


def warp_image(image2: ImageArray, flow: FlowArray) -> ImageArray:
    """A raster at x + flow(x), bilinear in float64, the border repeated outside; NaN where the flow is.

    SciPy, not OpenCV: before version 5, `cv2.remap` rounds positions to 1/32 px.
    """
    from scipy.ndimage import map_coordinates

    rows, columns = np.indices(flow.shape[:2], dtype=np.float64)
    position = np.stack([rows + flow[..., 1], columns + flow[..., 0]])
    unknown = np.isnan(position).any(axis=0)
    position[:, unknown] = 0.0
    channels = [map_coordinates(image2[..., c], position, order=1, mode="nearest") for c in range(image2.shape[2])]
    warped = np.stack(channels, axis=-1).astype(np.float32)
    warped[unknown] = np.nan
    return warped


def inside(flow: Flow) -> Mask:
    """1 where x + flow(x) lies between the pixel centres of the image, so that nothing is extrapolated; else 0.

    A flow of zero keeps every pixel, the border included. The mask carries no gradient.
    """
    return inside_at(positions(flow.detach()))


def inside_at(places: Tensor) -> Mask:
    """1 where places (B, 2, H, W), column and row, lie between the pixel centres of an image of H x W; else 0."""
    height, width = places.shape[-2:]
    x, y = places.unbind(dim=1)
    return ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).to(places.dtype).unsqueeze(1)
