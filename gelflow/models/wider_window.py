"""The window that fits the place: a flow under the window with the least estimated mean square error at each pixel.

Two Gauss-Newton steps in a Gaussian window of deviation s pass a wave of wave number k of motion and of noise by
``H_s(k) = 1 - (1 - exp(-(s k)^2 / 2))^2``. Noise of a step has a variance that falls with ``s^2`` and the square of the
images' gradient (Cramer-Rao; C of `gelflow.models.evidence`), and two steps have 11/6 of it. The bias is what H takes
from the motion, with the fourth power of s times its curvature's curvature. So a flow V, found under a narrow window,
is smoothed by H of wider ones, pixels weighted by their texture: as good as steps in these windows, without the images.
Which one is best is estimated without bias (Stein 1981; Lepski 1991),

    risk_s = <|H_s V - V|^2 / var V> + 2 cov(H_s V, V) / var V - 1,

< > a mean under the window. The narrow window's risk is 1. In the same way `bends` tells where a still narrower window,
whose steps do need the images, is better than V.
"""

import functools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gelflow.arrays import Features, Flow
from gelflow.ops.gaussian import SeparableFilter, window_sums

WIDTHS_PX = (6.0, 12.0, 20.0)
"""Standard deviations of the windows that a pixel may choose, beside its own."""
TWO_STEPS = 11 / 6
"""Variance of the noise after two steps over that of one."""
MIN_VARIANCE = 1e-8
"""Of a flow, px^2; of equal images it would be zero."""
BEND_WINDOW_PX = 8.0
"""Standard deviation of the window in which `bends` compares two flows."""
FLAT = 0.04
"""Sum of squared gradients in a window below which pixels count alike; what the network's flow is worth by default."""


def best_window(flow: Flow, variance: Tensor, texture: Tensor, window_px: float, pixel: int = 1) -> tuple[Flow, Tensor]:
    """Smooths a flow (B, 2, H, W) where that makes it more precise; the flow, and its mean square error, px^2.

    It was found by two steps in a window of the standard deviation `window_px`. `variance` is that of its noise, both
    components together, (B, 1, H, W) px^2; `texture` is the sum of the squares of the gradient in the window, (B, 1, H,
    W). All are known at every `pixel`-th px along each axis.
    """
    variance, weight = variance.clamp(min=MIN_VARIANCE), texture.clamp(min=0) + FLAT
    least, error = torch.ones_like(variance), variance
    best = flow
    for width in WIDTHS_PX:
        mean = _mean(weight, window_sums(flow, width / pixel))
        wide = mean(flow)
        wide = wide + mean(flow - wide)
        shared, left = _noise_shares(window_px, width)
        apart = (wide - flow).square().sum(dim=1, keepdim=True)
        risk = mean(apart / variance) + 2 * shared - 1
        better = risk < least
        best, least = torch.where(better, wide, best), torch.where(better, risk, least)
        error = torch.where(better, variance * risk.clamp(min=left), error)
    return best, error


def bends(
    flow: Flow, fine: Flow, variance: Tensor, windows_px: tuple[float, float], reach_px: float, pixel: int = 1
) -> Tensor:
    """Where two more steps in a narrower window improved a flow; bool, (B, 1, H, W).

    `fine` is the flow after them, `variance` that of its noise, `windows_px` the deviations of both windows. False
    where the flows differ by more than `reach_px` (root mean square): there the steps have lost the pattern. All are
    known at every `pixel`-th px along each axis.
    """
    apart = (fine - flow).square().sum(dim=1, keepdim=True)
    mean = _mean(torch.ones_like(apart), window_sums(flow, BEND_WINDOW_PX / pixel))
    risk = mean(apart / variance.clamp(min=MIN_VARIANCE)) + 2 * fine_noise(*windows_px)[0] - 1
    return (risk >= 1) & (mean(apart) <= reach_px**2)


@functools.cache
def fine_noise(window_px: float, fine_px: float) -> tuple[float, float]:
    """Two ratios for the noise of a flow after two more steps in a narrower window.

    The first is its covariance with the noise before these steps over its variance; the second is that variance over
    that of one step in the narrower window alone.
    """
    k = np.linspace(0, 5 / fine_px, 1001)
    wide, fine = (np.exp(-((deviation * k) ** 2) / 2) for deviation in (window_px, fine_px))
    before = 1 - (1 - wide) ** 2
    after = 1 - (1 - fine) ** 2 * (1 - before)
    total = (k * after**2).sum()
    return float((k * before * after).sum() / total), float(total / (k * fine**2).sum())


def _mean(weight: Tensor, window: SeparableFilter) -> Callable[[Features], Features]:
    """Gives the weighted mean of each channel under a window."""
    total = window(weight)
    return lambda field: window(weight * field) / total


@functools.cache
def _noise_shares(window_px: float, width: float) -> tuple[float, float]:
    """Covariance of the noise before and after smoothing, and variance after it, over the variance before."""
    k = np.linspace(0, 5 / window_px, 1001)
    steps, wide = (1 - (1 - np.exp(-((deviation * k) ** 2) / 2)) ** 2 for deviation in (window_px, width))
    noise = k * steps**2
    return float((noise * wide).sum() / noise.sum()), float((noise * wide**2).sum() / noise.sum())
