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
from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features, Flow, Images
from gelflow.ops.gaussian import doubled, window_sums
from gelflow.ops.warp import inside_at, positions

TINY = 1e-6
CORRELATION_PX = 1.0
"""Standard deviation of the Gaussian under which g r is summed."""
MAX_VARIANCE = 100.0
"""Of a step, px^2; also where a window holds no texture."""


class Step(NamedTuple):
    """A Gauss-Newton step (B, 2, h, w), px, zero where the window holds no texture.

    The variance is Tr C, at most `MAX_VARIANCE`, (B, 1, h, w) px^2, the texture Tr A, (B, 1, h, w).
    """

    step: Flow
    variance: Tensor
    texture: Tensor


Sample = Callable[[Tensor], Images]
"""Image 2 at places (B, 2, H, W): `SplineImage.at` or `.near`, for which dampened patterns count as noise."""


def compared(flow: Flow, first: Images, second: Sample) -> tuple[Images, Images, Tensor]:
    """Image 2 less image 1 under a flow, the mean of both, (B, C, H, W), and where the flow stays, (B, 1, H, W)."""
    places = positions(flow)
    moved = second(places)
    # The mean of both images' gradients converges from further away than either alone.
    return moved - first, (moved + first) / 2, inside_at(places)


def without_mean(image: Features, counts: Tensor, deviation: float) -> Features:
    """An image less its mean in a Gaussian over the pixels that count, (B, 1, H, W)."""
    window = window_sums(image, deviation, 2)
    mean = doubled(window(counts * image) / window(counts).clamp(min=TINY))
    return image - mean[..., : image.shape[-2], : image.shape[-1]]


def slopes(image: Features) -> tuple[Features, Features]:
    """Central differences along x and y; half of one-sided ones at the border."""
    padded = F.pad(image / 2, (1, 1, 1, 1), mode="replicate")
    rows, columns = padded[..., 1:-1, :], padded[..., 1:-1]
    return rows[..., 2:] - rows[..., :-2], columns[..., 2:, :] - columns[..., :-2, :]


def moments(flow: Flow, first: Images, second: Sample, background_px: float | None) -> Tensor:
    """Of a flow: xx, xy, xr, yy, yr and rr of gradient and residual, and the number of samples.

    They are sums over the colours, zero where the flow leaves the image, (B, 7, H, W).
    """
    if flow.is_cuda and background_px is not None:
        from gelflow.models import fused_registration as fused

        moved = second(positions(flow))
        weighted = fused.counted(flow, first, moved, both=False)
        return fused.moments(first, moved, weighted, window_sums(flow, background_px, 2)(weighted))
    residual, mean, counts = compared(flow, first, second)
    if background_px is not None:
        residual = without_mean(residual, counts, background_px)
    across, down = slopes(mean)
    pairs = ((across, across), (across, down), (across, residual), (down, down), (down, residual), (residual, residual))
    found = flow.new_zeros(len(flow), 7, *flow.shape[2:])
    for plane, pair in zip(found.unbind(dim=1), pairs, strict=False):
        _add_products(plane, *pair)
    found[:, 6] = residual.shape[1]
    return found.mul_(counts)


def evidence(flow: Flow, first: Images, second: Sample, background_px: float) -> Tensor:
    """What each pixel adds to A and to z z^T under a flow, three each, and to -b: (B, 8, H, W)."""
    correlated, norm = window_sums(flow, CORRELATION_PX), math.sqrt(math.pi) * CORRELATION_PX
    if flow.is_cuda:
        from gelflow.models import fused_registration as fused

        moved = second(positions(flow))
        weighted = fused.counted(flow, first, moved, both=True)
        found = fused.evidence(first, moved, weighted, window_sums(flow, background_px, 2)(weighted))
        return fused.add_squares(found, correlated(found[:, 6:]), norm**-2)
    residual, mean, counts = compared(flow, first, second)
    both = without_mean(torch.cat([residual, mean], dim=1), counts, background_px)
    residual, mean = both.chunk(2, dim=1)
    (right, below), (across, down) = slopes(residual / 2), slopes(mean)
    found = flow.new_zeros(len(flow), 8, *flow.shape[2:])
    gradients, noises = (
        ((across, across), (across, down), (down, down)),
        ((right, right), (right, below), (below, below)),
    )
    for plane, gradient, noise in zip(found[:, :3].unbind(dim=1), gradients, noises, strict=True):
        _add_products(plane, *gradient)
        _add_products(plane, *noise, sign=-1)
    _add_products(found[:, 6], across, residual)
    _add_products(found[:, 7], down, residual)
    found *= counts
    x, y = (correlated(found[:, 6:]) / norm).unbind(dim=1)
    for plane, (one, other) in zip(found[:, 3:6].unbind(dim=1), ((x, x), (x, y), (y, y)), strict=True):
        torch.mul(one, other, out=plane)
    return found


def step(found: Tensor, window_px: float, spacing: int = 1) -> Step:
    """The step of `evidence` in a window of that standard deviation, without a prior, at places at a spacing."""
    return solved(window_sums(found, window_px, spacing)(found))


def solved(sums: Tensor) -> Step:
    """The step of `evidence` that a window has summed."""
    if sums.is_cuda:
        from gelflow.models import fused_registration as fused

        return Step(*fused.solved(sums, MAX_VARIANCE).split([2, 1, 1], dim=1))
    xx, xy, yy, one, two, three, right, left = sums.split(1, dim=1)
    determinant, trace = xx * yy - xy.square(), xx + yy
    variance = one * (yy.square() + xy.square()) - 2 * two * xy * trace + three * (xx.square() + xy.square())
    # The sum under w^2 is about half of that under w.
    variance = variance / (2 * determinant.square())
    # Terms that cancel leave rounding errors of either sign where there is nothing to see.
    enough = (determinant > 0) & (trace > 0) & (variance >= 0) & (variance < MAX_VARIANCE)
    step = torch.cat([xy * left - yy * right, xy * right - xx * left], dim=1) / determinant
    return Step(torch.where(enough, step, 0.0), torch.where(enough, variance, MAX_VARIANCE), trace)


def _add_products(plane: Tensor, one: Features, other: Features, sign: int = 1) -> None:
    """Adds to (B, H, W) the products of two images, summed over the colours."""
    for first, second in zip(one.unbind(dim=1), other.unbind(dim=1), strict=True):
        plane.addcmul_(first, second, value=sign)
