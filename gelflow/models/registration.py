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

Gauss-Newton steps stay in the basin that they start in. With `propagation_px` each stage therefore tries neighbours'
flows first (`gelflow.models.propagation`); where a whole neighbourhood mistook dots for the next ones, that does not
help. With `after`, another registration comes before all stages. Its flow stays wherever the residual that it leaves is
below its `noise`. So registration for both keeps the motion where motion explains the images, and follows brightness
elsewhere. Where shading is ignored, each pixel finally takes the window that fits it (`gelflow.models.wider_window`):
the last stage's, a wider one, or where the flow bends, that of a further stage.

Lucas and Kanade 1981, with a prior (Simoncelli, Adelson and Heeger, "Probability distributions of optical flow", 1991);
smoothing the field between the steps: Thirion's demons, 1998.
"""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.models.evidence import TINY, Evidence, evidence, gauss_newton
from gelflow.models.propagation import propagated
from gelflow.models.wider_window import TWO_STEPS, bends, best_window, fine_noise
from gelflow.ops.gaussian import SeparableFilter, smoother, window_sums
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import positions

MAX_STEP_PX = 1.0
"""Limit on a Gauss-Newton step of each component."""
FINE_WINDOW_PX, FINE_SMOOTHING_PX, FINE_PRIOR_PX = 3.0, 1.0, 0.3
"""Window, smoothing and prior of the further stage."""
RESIDUAL_WINDOW_PX, BLENDING_PX = 6.0, 2.0
"""Standard deviations of the window of the residual that decides between two flows, and of the blending at its edge."""


def registered(flow: Flow, image1: Images, image2: Images, config: RegistrationConfig) -> Flow:
    """Corrects a flow; same shape, float32, without gradient. Each pair of a batch is treated on its own."""
    with torch.no_grad(), torch.autocast(flow.device.type, enabled=False):
        flow, first, image2 = flow.float(), image1.float(), image2.float()
        second = SplineImage(image2)
        former = flow
        if config.after is not None:
            former = flow = registered(flow, first, image2, config.after)
        for window_px, smoothing_px in zip(config.windows_px, config.smoothing_px, strict=True):
            if config.propagation_px:
                flow = propagated(flow, first, image2, window_px, config)
            flow = _stage(flow, first, second, window_px, smoothing_px, config)
        if config.background_px is not None:
            last = gauss_newton(flow, first, second, config)
            variance = posterior_variance(TWO_STEPS * last.variance, config.prior_px)
            flow = _fitted(flow, variance, last.texture, first, second, config)
        if config.after is not None:
            flow = torch.lerp(former, flow, _unexplained(former, first, second, config.after.noise))
    return flow


def _fitted(
    flow: Flow, variance: Tensor, texture: Tensor, first: Images, second: SplineImage, config: RegistrationConfig
) -> Flow:
    """At each pixel, the flow of the window that fits it, from a flow that was found in the last stage's window.

    `variance` is that of its noise, and `texture` as of `gelflow.models.evidence.Step`.
    """
    windows = config.windows_px[-1], FINE_WINDOW_PX
    best, _ = best_window(flow, variance, window_sums(flow, windows[0])(texture), windows[0])
    if windows[0] <= FINE_WINDOW_PX:
        return best
    further = config.model_copy(update={"windows_px": (FINE_WINDOW_PX,), "prior_px": FINE_PRIOR_PX})
    fine = _stage(flow, first, second, FINE_WINDOW_PX, FINE_SMOOTHING_PX, further)
    noise = fine_noise(*windows)[1] * gauss_newton(fine, first, second, further).variance
    bent = bends(flow, fine, posterior_variance(noise, FINE_PRIOR_PX), windows, FINE_PRIOR_PX)
    return torch.where(bent, fine, best)


def posterior_variance(variance: Tensor, prior_px: float) -> Tensor:
    """Variance of a flow, both components together, px^2, from that of its noise and a prior of `prior_px` on each."""
    return 1 / (1 / variance + 1 / (2 * prior_px**2))


def _stage(
    flow: Flow, first: Images, second: SplineImage, window_px: float, smoothing_px: float, config: RegistrationConfig
) -> Flow:
    """Gauss-Newton steps in one window from the smoothed flow."""
    window = window_sums(flow, window_px)
    background = None if config.background_px is None else window_sums(flow, config.background_px)
    start = flow = smoother(flow, smoothing_px)(flow)
    for _ in range(config.iterations):
        step = _posterior(evidence(flow, first, second, background), flow - start, window, config)
        flow = flow + step.clamp(-MAX_STEP_PX, MAX_STEP_PX)
    return flow


def _unexplained(flow: Flow, first: Images, second: SplineImage, noise: float) -> Tensor:
    """1 where a flow leaves more than noise between the images, 0 where not, between them at an edge; (B, 1, H, W).

    Where a flow leaves the image, the border counts that `SplineImage` repeats there.
    """
    squares = (second.at(positions(flow)) - first).square().mean(dim=1, keepdim=True)
    window, edge = window_sums(flow, RESIDUAL_WINDOW_PX), window_sums(flow, BLENDING_PX)
    all_of_it = torch.ones_like(squares)
    left = (window(squares) > noise**2 * window(all_of_it)).float()
    return edge(left) / edge(all_of_it)


def _posterior(found: Evidence, so_far: Flow, window: SeparableFilter, config: RegistrationConfig) -> Flow:
    """The Gauss-Newton step (B, 2, H, W): the solution of a system of two equations at each pixel."""
    residual, across, down, counts = found
    three = torch.stack([across, down, residual], dim=1)
    products = torch.cat(
        [across.unsqueeze(1) * three, down.unsqueeze(1) * three[:, 1:], residual.square().unsqueeze(1)], dim=1
    )
    xx, xy, xr, yy, yr, rr, pixels = window(torch.cat([products.sum(dim=2), counts], dim=1)).split(1, dim=1)
    variance = rr / (residual.shape[1] * pixels).clamp(min=TINY) + config.noise**2
    weight = variance / config.prior_px**2
    xx, yy = xx + weight, yy + weight
    u, v = (-torch.cat([xr, yr], dim=1) - weight * so_far).split(1, dim=1)
    return torch.cat([yy * u - xy * v, xx * v - xy * u], dim=1) / (xx * yy - xy.square())
