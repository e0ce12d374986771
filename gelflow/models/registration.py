"""Registration: the network's flow, corrected by what still differs between the images. Nothing is learned.

At each of a few stages the flow so far is smoothed to ``U``, and Gauss-Newton steps look at each pixel for the
correction ``d`` with the largest posterior probability, if the residual within a Gaussian window w is noise and the
network is wrong by some ``p`` px:

    sum_y w(y - x) |F2(y + U + d) - F1(y)|^2 / s^2 + |d|^2 / p^2  ->  min,

``s^2`` the variance of the residual in the window and, added to it, that of `noise`: the camera's, and what shading
changes. Where the window holds no texture, the flow remains the network's. F are the colours; with `background_px`, the
residual is taken without its mean over a neighbourhood of that width, so that shading, which does not move with the
gel, does not count. Without, and with a wide ``p``, the images' difference is what is minimised, whatever it comes
from: a high PSNR, and a flow that follows shading.

Gauss-Newton steps stay in the basin that they start in. With `propagation_px` the first and the last stage therefore
try neighbours' flows first (`gelflow.models.propagation`); where a whole neighbourhood mistook dots for the next ones,
that does not help. With `after`, another registration comes before all stages. Its flow stays wherever the residual
that it leaves is below its `noise`. So registration for both keeps the motion where motion explains the images, and
follows brightness elsewhere. Where shading is ignored, each pixel finally takes the window that fits it
(`gelflow.models.wider_window`): the last stage's, a wider one, or where the flow bends, that of a further stage.

Lucas and Kanade 1981, with a prior (Simoncelli, Adelson and Heeger, "Probability distributions of optical flow", 1991);
smoothing the field between the steps: Thirion's demons, 1998.
"""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.models.evidence import TINY, evidence, moments, step
from gelflow.models.propagation import propagated
from gelflow.models.wider_window import TWO_STEPS, bends, best_window, fine_noise
from gelflow.ops.gaussian import interpolator, smoother, window_sums
from gelflow.ops.pyramid import halve
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import positions

HALF_SIZE_PX, SPACED_PX, SPACING = 12.0, 3.0, 2
"""Windows from which on images of half the size suffice, and a flow at every second px."""
MAX_STEP_PX = 1.0
"""Limit on a Gauss-Newton step of each component."""
FINE_WINDOW_PX, FINE_SMOOTHING_PX, FINE_PRIOR_PX = 3.0, 1.0, 0.3
"""Window, smoothing and prior of the further stage."""
RESIDUAL_WINDOW_PX, BLENDING_PX = 6.0, 2.0
"""Standard deviations of the window of the residual that decides between two flows, and of the blending at its edge."""


def registered(flow: Flow, image1: Images, image2: Images | SplineImage, config: RegistrationConfig) -> Flow:
    """Corrects a flow; same shape, float32, without gradient. Each pair of a batch is treated on its own."""
    with torch.no_grad(), torch.autocast(flow.device.type, enabled=False):
        second = image2 if isinstance(image2, SplineImage) else SplineImage(image2.float())
        flow, first, image2 = flow.float(), image1.float(), second.image
        half1, half2 = halve(first), SplineImage(halve(image2))
        coarse = config.model_copy(update={"background_px": config.background_px and config.background_px / 2})
        former = flow
        if config.after is not None:
            former = flow = registered(flow, first, second, config.after)
        for window_px, smoothing_px in zip(config.windows_px, config.smoothing_px, strict=True):
            if config.propagation_px and window_px in (config.windows_px[0], config.windows_px[-1]):
                flow = propagated(flow, first, image2, window_px, config)
            if window_px >= HALF_SIZE_PX:
                found = 2 * _stage(halve(flow) / 2, half1, half2, window_px / 2, smoothing_px / 2, coarse)
                flow = interpolator(flow, 2 * SPACING)(found)
            else:
                found = _stage(flow, first, second, window_px, smoothing_px, config)
                flow = interpolator(flow, _spacing(window_px))(found)
        if config.background_px is not None:
            flow = _fitted(found, flow, first, second, config)
        if config.after is not None:
            flow = torch.lerp(former, flow, _unexplained(former, first, second, config.after.noise))
    return flow


def _spacing(window_px: float) -> int:
    """Px between the places at which a window of that deviation finds a flow."""
    return SPACING if window_px >= SPACED_PX else 1


def _fitted(found: Flow, flow: Flow, first: Images, second: SplineImage, config: RegistrationConfig) -> Flow:
    """At each pixel, the flow of the window that fits it.

    The last stage found a flow at its places, which is `flow` at each pixel.
    """
    windows, background_px = (config.windows_px[-1], FINE_WINDOW_PX), config.background_px or 0.0
    spacing = _spacing(windows[0])
    last = step(evidence(flow, first, second.near, background_px), windows[0], spacing)
    variance = posterior_variance(TWO_STEPS * last.variance, config.prior_px)
    best, _ = best_window(found, variance, last.texture, windows[0], spacing)
    to_pixels = interpolator(flow, spacing)
    if windows[0] > FINE_WINDOW_PX:
        further = config.model_copy(update={"prior_px": FINE_PRIOR_PX})
        fine = _stage(flow, first, second, FINE_WINDOW_PX, FINE_SMOOTHING_PX, further)
        there = step(evidence(to_pixels(fine), first, second.near, background_px), FINE_WINDOW_PX, spacing)
        variance = posterior_variance(fine_noise(*windows)[1] * there.variance, FINE_PRIOR_PX)
        best = torch.where(bends(found, fine, variance, windows, FINE_PRIOR_PX, spacing), fine, best)
    return to_pixels(best)


def posterior_variance(variance: Tensor, prior_px: float) -> Tensor:
    """Variance of a flow, both components together, px^2, from that of its noise and a prior of `prior_px` on each."""
    return 1 / (1 / variance + 1 / (2 * prior_px**2))


def _stage(
    flow: Flow, first: Images, second: SplineImage, window_px: float, smoothing_px: float, config: RegistrationConfig
) -> Flow:
    """Gauss-Newton steps in one window from the smoothed flow; what they find at places as far apart as it allows."""
    spacing = _spacing(window_px)
    window, to_pixels = window_sums(flow, window_px, spacing), interpolator(flow, spacing)
    start = found = smoother(flow, smoothing_px, spacing)(flow)
    sample = second.near if spacing > 1 else second.at
    for _ in range(config.iterations):
        sums = window(moments(to_pixels(found), first, sample, config.background_px))
        if found.is_cuda:
            from gelflow.models import fused_registration as fused

            found = fused.posterior(sums, found, start, config.noise, config.prior_px, MAX_STEP_PX)
        else:
            found = found + _posterior(sums, found - start, config).clamp(-MAX_STEP_PX, MAX_STEP_PX)
    return found


def _unexplained(flow: Flow, first: Images, second: SplineImage, noise: float) -> Tensor:
    """1 where a flow leaves more than noise between the images, 0 where not, between them at an edge; (B, 1, H, W).

    Where a flow leaves the image, the border counts that `SplineImage` repeats there.
    """
    squares = (second.at(positions(flow)) - first).square().mean(dim=1, keepdim=True)
    window, edge = window_sums(flow, RESIDUAL_WINDOW_PX), window_sums(flow, BLENDING_PX)
    all_of_it = torch.ones_like(squares)
    left = (window(squares) > noise**2 * window(all_of_it)).float()
    return edge(left) / edge(all_of_it)


def _posterior(sums: Tensor, so_far: Flow, config: RegistrationConfig) -> Flow:
    """The Gauss-Newton step (B, 2, h, w) from `moments` in a window: the solution of two equations at each place."""
    xx, xy, xr, yy, yr, rr, samples = sums.split(1, dim=1)
    variance = rr / samples.clamp(min=TINY) + config.noise**2
    weight = variance / config.prior_px**2
    xx, yy = xx + weight, yy + weight
    u, v = (-torch.cat([xr, yr], dim=1) - weight * so_far).split(1, dim=1)
    return torch.cat([yy * u - xy * v, xx * v - xy * u], dim=1) / (xx * yy - xy.square())
