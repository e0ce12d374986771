"""Gaussian windows over images, as one dense matrix for each axis: ``G_y F G_x^T`` for a field F (B, C, H, W).

Windows end at three standard deviations. On a processor the matrices are faster than the same windows as convolutions.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gelflow.arrays import Features
from gelflow.ops.cached import cached


class SeparableFilter(NamedTuple):
    """A linear filter along both axes of fields of one size."""

    down: Tensor
    across: Tensor

    def __call__(self, field: Features) -> Features:
        """Filters each channel of (B, C, H, W); same shape."""
        return self.down @ field @ self.across.T


def window_sums(like: Tensor, deviation: float) -> SeparableFilter:
    """Sums under a Gaussian of height one around each pixel; nothing is added where the window leaves the image.

    `like` is a (..., H, W) with the fields' sides, dtype and device; `deviation` is the standard deviation in px.
    """
    return SeparableFilter(*(_sums(pixels, deviation, like.dtype, like.device) for pixels in like.shape[-2:]))


def smoother(like: Tensor, deviation: float) -> SeparableFilter:
    """Means under a Gaussian around each pixel; arguments as for `window_sums`, a deviation of 0 changes nothing.

    Beyond the border fields go on turned about their border's pixel, so that affine fields stay as they are up to the
    border; under a mean over what lies inside, the border of a rotation or an enlargement would follow the inside.
    """
    return SeparableFilter(*(_mean(pixels, deviation, like.dtype, like.device) for pixels in like.shape[-2:]))


@cached
def _sums(pixels: int, deviation: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (n, n) of the sums along one axis."""
    return _window(pixels, 0, deviation, math.ceil(3 * deviation), device).to(dtype)


@cached
def _mean(pixels: int, deviation: float, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (n, n) of the mean along one axis."""
    if deviation == 0:
        return torch.eye(pixels, dtype=dtype, device=device)
    beyond = min(math.ceil(3 * deviation), pixels - 1)
    weight = _window(pixels, beyond, deviation, beyond, device)
    before, matrix, after = (weight / weight.sum(dim=1, keepdim=True)).split([beyond, pixels, beyond], dim=1)
    # F(-k) = 2 F(0) - F(k), and the same at the other end.
    matrix = matrix.clone()
    matrix[:, 0] += 2 * before.sum(dim=1)
    matrix[:, -1] += 2 * after.sum(dim=1)
    matrix[:, 1 : beyond + 1] -= before.flip(1)
    matrix[:, -beyond - 1 : -1] -= after.flip(1)
    return matrix.to(dtype)


def _window(pixels: int, beyond: int, deviation: float, reach: int, device: torch.device) -> Tensor:
    """exp(-d² / 2 s²) of the distance d of pixels and positions up to `beyond` outside, (n, n + 2 beyond), float64."""
    place = torch.arange(-beyond, pixels + beyond, device=device)
    distance = place[beyond : beyond + pixels].view(-1, 1) - place.view(1, -1)
    weight = torch.exp(-torch.arange(pixels + 2 * beyond, device=device).double().square() / (2 * deviation**2))
    weight[reach + 1 :] = 0.0
    return weight[distance.abs()]
