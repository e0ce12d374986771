"""Evidence: what two images say of a flow, and how precisely.

A Gauss-Newton step d from the flow V solves ``A d = -b`` in a Gaussian window w:

    A = sum_y w(y - x) (g g^T - n n^T),    b = sum_y w(y - x) g r,

r the residual F2(y + V) - F1 and g the gradient of the images' mean, both without their mean over a neighbourhood,
because light on a gel does not move with it. Noise adds to gradients: n, half the residual's gradient, is taken off, so
that noise alone is no texture. If the residual were white noise, its variance times A^-1 would bound the variance of
any estimate (Cramer-Rao). It is correlated between colours and between pixels, so that the step's covariance is

    C = A^-1 (sum_y w(y - x)^2 z z^T) A^-1,

z the sum of g r over a small neighbourhood (Newey and West 1987).
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from gelflow.arrays import Features, Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.ops.gaussian import SeparableFilter, window_sums
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import inside_at, positions

Evidence = tuple[Features, Features, Features, Tensor]
TINY = 1e-6
CORRELATION_PX = 1.0
"""Standard deviation of the Gaussian under which g r is summed."""
MAX_VARIANCE = 100.0
"""Of a step, px^2; also where a window holds no texture."""


class Step(NamedTuple):
    """A Gauss-Newton step (B, 2, H, W), px, zero where the window holds no texture.

    The variance is Tr C, at most `MAX_VARIANCE`, (B, 1, H, W) px^2, the texture the sum of the squares of the gradient
    that each pixel adds to tr A, (B, 1, H, W).
    """

    step: Flow
    variance: Tensor
    texture: Tensor


def evidence(flow: Flow, first: Images, second: SplineImage, background: SeparableFilter | None) -> Evidence:
    """Residual, and the gradient along x and y of the mean of both images, (B, C, H, W), zero outside of image 2.

    The last: 1 where the flow stays in the image, else 0, (B, 1, H, W).
    """
    places = positions(flow)
    counts, moved = inside_at(places), second.at(places)
    residual = counts * (moved - first)
    if background is not None:
        mean, weight = background(torch.cat([residual, counts], dim=1)).split([residual.shape[1], 1], dim=1)
        residual = counts * (residual - mean / weight.clamp(min=TINY))
    # The mean of both images' gradients converges from further away than either alone.
    across, down = torch.gradient((moved + first) / 2, dim=(-1, -2))
    return residual, counts * across, counts * down, counts


def gauss_newton(flow: Flow, first: Images, second: SplineImage, config: RegistrationConfig) -> Step:
    """The step from a flow in the last window of a registration for motion, without a prior, and its variance."""
    background = window_sums(flow, config.background_px or 0.0)
    window = window_sums(flow, config.windows_px[-1])
    residual, across, down, counts = evidence(flow, first, second, background)
    weight = background(counts).clamp(min=TINY)
    across, down = (gradient - counts * background(gradient) / weight for gradient in (across, down))
    noise = (counts * slope / 2 for slope in torch.gradient(residual, dim=(-1, -2)))
    texture = _squares(across, down) - _squares(*noise)
    pull = torch.stack([across * residual, down * residual], dim=1).sum(dim=2)
    z = window_sums(flow, CORRELATION_PX)(pull) / (math.sqrt(math.pi) * CORRELATION_PX)
    return solved(texture, _squares(*z.split(1, dim=1)), pull, window)


def solved(texture: Tensor, z: Tensor, pull: Tensor, window: SeparableFilter) -> Step:
    """The step in a window, of what each pixel adds: to A and to z z^T, (B, 3, H, W) each, and to -b, (B, 2, H, W)."""
    # The sum under w^2 is about half of that under w.
    sums = window(torch.cat([texture, z / 2, pull], dim=1))
    xx, xy, yy, one, two, three, right, left = sums.split(1, dim=1)
    determinant, trace = xx * yy - xy.square(), xx + yy
    variance = one * (yy.square() + xy.square()) - 2 * two * xy * trace + three * (xx.square() + xy.square())
    variance = variance / determinant.square()
    # Terms that cancel leave rounding errors of either sign where there is nothing to see.
    enough = (determinant > 0) & (trace > 0) & (variance >= 0) & (variance < MAX_VARIANCE)
    step = torch.cat([xy * left - yy * right, xy * right - xx * left], dim=1) / determinant
    return Step(
        torch.where(enough, step, 0.0), torch.where(enough, variance, MAX_VARIANCE), texture[:, :1] + texture[:, 2:]
    )


def _squares(x: Features, y: Features) -> Tensor:
    """x^2, x y and y^2, summed over the colours: (B, 3, H, W) of (B, C, H, W)."""
    return torch.stack([x * x, x * y, y * y], dim=1).sum(dim=2)
