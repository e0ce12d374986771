"""Gaussian windows over images, as one dense matrix for each axis: ``G_y F G_x^T`` for a field F (B, C, H, W).

Windows end at three standard deviations. On a processor OpenCV sums under them in a sixth of the time of the matrices,
where no gradient is asked for. What a wide window leaves is as well known at every second pixel: with a `spacing` s,
windows lie around the places ``s i + (s - 1) / 2`` alone, ceil(H / s) and ceil(W / s) of them, and `interpolator` leads
back to each pixel. Pixels then count by cells of s by s, one around each place.
"""

import functools
import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.linalg import toeplitz
from torch import Tensor

from gelflow.arrays import Features
from gelflow.ops.cached import cached


class SeparableFilter(NamedTuple):
    """A linear filter along both axes of fields of one size; `kernel` is its window over cells of `spacing` px."""

    down: Tensor
    across: Tensor
    kernel: NDArray[np.float32] | None = None
    spacing: int = 1

    def __call__(self, field: Features) -> Features:
        """Filters each channel of (B, C, H, W)."""
        if self.kernel is None or not is_array(field):
            return self.down @ field @ self.across.T
        rows, columns = len(self.down), len(self.across)
        sums = field.new_empty(*field.shape[:2], rows, columns)
        beyond = (0, self.spacing * rows - field.shape[-2], 0, self.spacing * columns - field.shape[-1])
        for plane, out in zip(field.contiguous().flatten(0, 1).numpy(), sums.flatten(0, 1).numpy(), strict=True):
            whole = cv2.copyMakeBorder(plane, *beyond, cv2.BORDER_CONSTANT) if any(beyond) else plane
            cells = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
            cv2.sepFilter2D(cells, -1, self.kernel, self.kernel, out, borderType=cv2.BORDER_CONSTANT)
        return sums


def doubled(cells: Features) -> Features:
    """A field on cells of 2 x 2 px (B, C, h, w) at each pixel, (B, C, 2 h, 2 w), bilinear."""
    if not is_array(cells):
        return F.interpolate(cells, scale_factor=2.0, mode="bilinear")
    rows, columns = 2 * cells.shape[-2], 2 * cells.shape[-1]
    finer = cells.new_empty(*cells.shape[:2], rows, columns)
    for plane, out in zip(cells.contiguous().flatten(0, 1).numpy(), finer.flatten(0, 1).numpy(), strict=True):
        cv2.resize(plane, (columns, rows), out, interpolation=cv2.INTER_LINEAR)
    return finer


def is_array(field: Tensor) -> bool:
    """Whether OpenCV can compute on it."""
    return field.device.type == "cpu" and field.dtype == torch.float32 and not field.requires_grad


def window_sums(like: Tensor, deviation: float, spacing: int = 1) -> SeparableFilter:
    """Sums under a Gaussian of height one around each place; nothing is added where the window leaves the image.

    `like` is a (..., H, W) with the fields' sides, dtype and device; `deviation` is the standard deviation in px.
    """
    down, across = (_sums(pixels, deviation, spacing, like.dtype, like.device) for pixels in like.shape[-2:])
    return SeparableFilter(down, across, spacing * _kernel(deviation, spacing).astype(np.float32), spacing)


def smoother(like: Tensor, deviation: float, spacing: int = 1) -> SeparableFilter:
    """Means under a Gaussian around each place; arguments as for `window_sums`, a deviation of 0 changes nothing.

    Beyond the border fields go on turned about their border's pixel, so that affine fields stay as they are up to the
    border; under a mean over what lies inside, the border of a rotation or an enlargement would follow the inside.
    """
    down, across = (_mean(pixels, deviation, spacing, like.dtype, like.device) for pixels in like.shape[-2:])
    return SeparableFilter(down, across)


def interpolator(like: Tensor, spacing: int) -> SeparableFilter:
    """From places at a spacing to each pixel of a (..., H, W), by Keys' cubic convolution, turned beyond the border."""
    down, across = (_cubic(pixels, spacing, like.dtype, like.device) for pixels in like.shape[-2:])
    return SeparableFilter(down, across)


@cached
def _sums(pixels: int, deviation: float, spacing: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (n / s, n) of the sums along one axis."""
    kernel, cells = _kernel(deviation, spacing), math.ceil(pixels / spacing)
    column = np.pad(kernel[len(kernel) // 2 :], (0, cells))[:cells]
    return torch.from_numpy(toeplitz(column).repeat(spacing, axis=1)[:, :pixels]).to(device, dtype)


@functools.cache
def _kernel(deviation: float, spacing: int) -> NDArray[np.float64]:
    """exp(-d² / 2 s²) of distances in cells, up to three deviations; the cells change neither its sum nor its width."""
    narrowed = math.sqrt(deviation**2 - (spacing**2 - 1) / 12)
    distance = spacing * np.arange(-(reach := math.ceil(3 * deviation / spacing)), reach + 1)
    return np.asarray(deviation / narrowed * np.exp(-(distance**2) / (2 * narrowed**2)))


@cached
def _mean(pixels: int, deviation: float, spacing: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (n / s, n) of the mean along one axis."""
    deviation = max(deviation, (spacing - 1) / 2)  # no less than a place stands for
    if deviation == 0:
        return torch.eye(pixels, dtype=dtype, device=device)
    beyond = min(math.ceil(3 * deviation), pixels - 1)
    weight = _gaussian(_distances(pixels, spacing, beyond, device), deviation, beyond)
    return _turned(weight / weight.sum(dim=1, keepdim=True), beyond).to(dtype)


@cached
def _cubic(pixels: int, spacing: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (n, n / s) of the interpolation along one axis."""
    places = math.ceil(pixels / spacing)
    nodes = spacing * torch.arange(-2, places + 2, dtype=torch.float64, device=device) + (spacing - 1) / 2
    pixel = torch.arange(pixels, dtype=torch.float64, device=device)
    x = (pixel.view(-1, 1) - nodes).abs() / spacing
    near, far = (1.5 * x - 2.5) * x.square() + 1, ((-0.5 * x + 2.5) * x - 4) * x + 2
    return _turned(torch.where(x < 1, near, torch.where(x < 2, far, 0.0)), 2).to(dtype)


def _distances(pixels: int, spacing: int, beyond: int, device: torch.device) -> Tensor:
    """Of places at a spacing and pixels up to `beyond` outside, (n / s, n + 2 beyond) px, float64."""
    places = spacing * torch.arange(math.ceil(pixels / spacing), dtype=torch.float64, device=device) + (spacing - 1) / 2
    return (places.view(-1, 1) - torch.arange(-beyond, pixels + beyond, dtype=torch.float64, device=device)).abs()


def _gaussian(distance: Tensor, deviation: float, reach: int) -> Tensor:
    """exp(-d² / 2 s²) of distances, zero beyond `reach`."""
    return torch.where(distance <= reach, torch.exp(-distance.square() / (2 * deviation**2)), 0.0)


def _turned(weight: Tensor, beyond: int) -> Tensor:
    """A matrix without its `beyond` columns at each end: F(-k) = 2 F(0) - F(k), and the same at the other end."""
    before, matrix, after = weight.split([beyond, weight.shape[1] - 2 * beyond, beyond], dim=1)
    matrix = matrix.clone()
    matrix[:, 0] += 2 * before.sum(dim=1)
    matrix[:, -1] += 2 * after.sum(dim=1)
    matrix[:, 1 : beyond + 1] -= before.flip(1)
    matrix[:, -beyond - 1 : -1] -= after.flip(1)
    return matrix
