"""Uncertainty: how far a flow may be from the motion, from the two images alone. Nothing is learned.

A Gauss-Newton step d from the flow V, as in the last stage of `gelflow.models.registration`, solves ``A d = -b`` in a
Gaussian window w:

    A = sum_y w(y - x) (g g^T - n n^T),    b = sum_y w(y - x) g r,

r the residual F2(y + V) - F1 and g the gradient of the images' mean, both without their mean over a neighbourhood,
because light on a gel does not move with it. Noise adds to gradients: n, half the residual's gradient, is taken off, so
that noise alone is no texture. If the residual were white noise, its variance times A^-1 would bound the variance of
any estimate (Cramer-Rao). It is correlated between colours and between pixels, so that the step's covariance is

    C = A^-1 (sum_y w(y - x)^2 z z^T) A^-1,

z the sum of g r over a small neighbourhood (Newey and West 1987). A window has one flow for all its texture, which lies
at a mean square distance m from x, so that the flow's second derivatives V'' add an error. Together, as what is left of
a step is an error, too,

    sigma^2 = SCALE^2 (tr C + |d|^2 + (CURVATURE m |V''|)^2),

smoothed, because the flow is.

What the network knows does not count: of a bare gel nothing is known, however plausible its flow. An error that leaves
no trace in the images, such as dots taken for the next ones, is not seen.
"""

import math

import torch
from torch import Tensor

from gelflow.arrays import Features, Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.models.registration import TINY, evidence
from gelflow.ops.gaussian import SeparableFilter, smoother, window_sums
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import pixel_indices, positions

SCALE, CURVATURE = 0.96, 0.28
"""Fitted to the errors of the shipped network on synthetic pairs by `python -m benchmarks sigma`."""
CORRELATION_PX, SMOOTHING_PX = 1.0, 2.0
"""Standard deviations of the Gaussians under which g r is summed and sigma^2 is smoothed."""
CERTAIN_PX, UNKNOWN_PX, MAX_SIGMA_PX = 0.1, 1.0, 10.0
"""A flow counts as certain up to the first sigma and as unknown above the second; the last: nothing is known."""
RADIUS = math.sqrt(-2 * math.log(1 - 0.68))
"""Radius that holds 68 % of a normal distribution in the plane whose components have a standard deviation of 1."""
_MOTION = RegistrationConfig()


def flow_sigma(flow: Flow, image1: Images, image2: Images) -> tuple[Tensor, Tensor]:
    """The uncertainty of a flow (B, 2, H, W), by whatever method.

    Returns:
        Sigma, the radius in px within which 68 % of such flows are right, at most `MAX_SIGMA_PX`; and the probability
        that the pixel's point lies in image 2. Both are (B, 1, H, W), and `MAX_SIGMA_PX` and 0 where the flow is NaN.
    """
    with torch.no_grad(), torch.autocast(flow.device.type, enabled=False):
        known, flow = flow.isfinite().all(dim=1, keepdim=True), flow.float().nan_to_num()
        step, curvature = error_squares(flow, image1.float(), image2.float())
        sigma = SCALE * smoothed(step + CURVATURE**2 * curvature).sqrt()
        sigma = torch.where(known, sigma, MAX_SIGMA_PX).clamp(max=MAX_SIGMA_PX)
        sides = flow.new_tensor([flow.shape[-1], flow.shape[-2]]).view(2, 1, 1)
        place, spread = positions(flow) + 0.5, sigma / RADIUS
        inside = torch.special.ndtr((sides - place) / spread) - torch.special.ndtr(-place / spread)
        return sigma, known * inside.prod(dim=1, keepdim=True)


def error_squares(flow: Flow, image1: Images, image2: Images) -> tuple[Tensor, Tensor]:
    """Tr C + |d|^2 and (m |V''|)^2, both (B, 1, H, W) px^2; infinite and 0 where a window holds no texture."""
    size = (flow.shape[-2], flow.shape[-1])
    background = window_sums(*size, _MOTION.background_px or 0.0, flow)
    residual, across, down, counts = evidence(flow, image1, SplineImage(image2), background)
    weight = background(counts).clamp(min=TINY)
    across, down = (gradient - counts * background(gradient) / weight for gradient in (across, down))
    noise = (counts * slope / 2 for slope in torch.gradient(residual, dim=(-1, -2)))
    texture = _squares(across, down) - _squares(*noise)
    pull = torch.stack([across * residual, down * residual], dim=1).sum(dim=2)
    z = window_sums(*size, CORRELATION_PX, flow)(pull) / (math.sqrt(math.pi) * CORRELATION_PX)
    window = window_sums(*size, _MOTION.windows_px[-1], flow)
    moment = _second_moment(window, texture[:, :1] + texture[:, 2:])
    # The sum under w^2 is about half of that under w.
    sums = window(torch.cat([texture, _squares(*z.split(1, dim=1)) / 2, pull], dim=1))
    (xx, xy, yy), (right, left) = sums[:, :3].split(1, dim=1), sums[:, 6:].split(1, dim=1)
    one, two, three = (sums[:, 3:6] + _squares(right, left)).split(1, dim=1)
    determinant, trace = xx * yy - xy.square(), xx + yy
    step = one * (yy.square() + xy.square()) - 2 * two * xy * trace + three * (xx.square() + xy.square())
    enough = (determinant > 0) & (trace > 0)
    step = torch.where(enough, step / determinant.square(), torch.inf)
    return step, torch.where(enough, (moment / trace).square() * _curvature_square(flow), 0.0)


def smoothed(square: Tensor) -> Tensor:
    """The mean of squared errors in px^2 around each pixel; the largest count as much as `MAX_SIGMA_PX`."""
    window = window_sums(square.shape[-2], square.shape[-1], SMOOTHING_PX, square)
    return window(square.clamp(max=(MAX_SIGMA_PX / SCALE) ** 2)) / window(torch.ones_like(square))


def _squares(x: Features, y: Features) -> Tensor:
    """x^2, x y and y^2, summed over the colours: (B, 3, H, W) of (B, C, H, W)."""
    return torch.stack([x * x, x * y, y * y], dim=1).sum(dim=2)


def _second_moment(window: SeparableFilter, field: Features) -> Features:
    """The sum of w(y - x) |y - x|^2 f(y)."""
    x, y = pixel_indices(field)
    down, across = (m * (p.view(-1, 1) - p).square() for m, p in zip(window, (y[:, 0], x[0]), strict=True))
    return SeparableFilter(down, window.across)(field) + SeparableFilter(window.down, across)(field)


def _curvature_square(flow: Flow) -> Tensor:
    """|V''|^2 of the flow under the last stage's smoothing, px^-2; (B, 1, H, W)."""
    smooth = smoother(flow.shape[-2], flow.shape[-1], _MOTION.smoothing_px[-1], flow)(flow)
    slopes = torch.cat(torch.gradient(smooth, dim=(-1, -2)), dim=1)
    return torch.cat(torch.gradient(slopes, dim=(-1, -2)), dim=1).square().sum(dim=1, keepdim=True)
