"""Propagation: a pixel whose flow does not bring the images together takes the flow of a neighbour that does.

Gauss-Newton steps find the minimum that they start near. A network that loses a dot leaves a patch of flow from which
none of its steps leads back, while the flow of the gel beside the patch would. So the flows of neighbours at some
distances are proposed to each pixel, and it takes the one with the least windowed residual,

    E(x) = sum_y w(y - x) c(y) |F2(y + V(y)) - F1(y) - m(x)|^2 / sum_y w(y - x) c(y),

if that is below a share of its own (c is 1 where the flow stays in the image). Where shading is ignored, a proposal is
the neighbour's flow extrapolated by its slope, because a gel's flow is smooth, and m is the residual's mean in the
window, because light on a gel does not move with it. The residual must also be below that share of what unrelated
images leave, Var F1 + Var F2: a flow into clipped white leaves little, but explains nothing. Where flow follows
brightness, it is proposed as it is, and m is zero. Windows are wide and smooth, so that images and flow are reduced
until a pixel is a third of the window's deviation.

Nothing is searched for, so that a pattern's period proposes nothing that is not some neighbour's flow already. A window
that the flow takes out of the image has no residual, and takes a neighbour's flow that keeps it inside.

After the propagation of PatchMatch (Barnes et al. 2009), without its random search; slanted as in PatchMatch Stereo
(Bleyer, Rhemann and Rother 2011).
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from gelflow.arrays import Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.ops.cached import cached
from gelflow.ops.gaussian import SeparableFilter, smoother, window_sums
from gelflow.ops.pyramid import resize_flow, resize_images
from gelflow.ops.warp import inside, warp

DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1), (-1, 1), (1, -1))
MAX_RESIDUAL_RATIO, MAX_RESIDUAL_RATIO_WITHOUT_SHADING = 0.85, 0.6
"""A proposal is taken if its residual is below this share of the pixel's own."""
PIXELS_PER_DEVIATION = 3
"""Largest standard deviation of a window in the reduced images, px."""
CACHED_PX = 50000
"""Px of proposals that are compared at a time on a processor."""
SLOPE_WINDOW_PX = 2.0
"""Standard deviation of the Gaussian under which a flow is smoothed before it is extrapolated, reduced px."""
MIN_SHARE_INSIDE = 0.3
"""Share of a window's weight that must lie in the image for its residual to count."""


def propagated(flow: Flow, image1: Images, image2: Images, window_px: float, config: RegistrationConfig) -> Flow:
    """The flow (B, 2, H, W), px, after each pixel has had the choice among its neighbours' flows.

    Images are (B, C, H, W); `window_px` is the standard deviation of w. Neighbours are at the distances of the
    configuration, each in eight directions. Where the residual is below twice its `noise`, the flow stays; shading is
    ignored if it has a background.
    """
    ignore_shading = config.background_px is not None
    height, width = flow.shape[-2:]
    pixel = math.ceil(window_px / PIXELS_PER_DEVIATION)
    size = (math.ceil(height / pixel), math.ceil(width / pixel))
    start, first, second = resize_flow(flow, size), resize_images(image1, size), resize_images(image2, size)
    window = window_sums(start, window_px / pixel)

    def residuals(candidates: Tensor) -> Tensor:
        """E of (N, B, 2, H, W): (N, B, 1, H, W)."""
        left = windowed_residual(candidates.flatten(0, 1), first, second, window, ignore_shading)
        return left.unflatten(0, (len(candidates), -1))

    now = residuals(start.unsqueeze(0))[0]
    taken = now > (2 * config.noise) ** 2
    if not flow.is_cuda and not taken.any():  # a recorded CUDA graph cannot choose
        return flow
    best, least = start, (MAX_RESIDUAL_RATIO_WITHOUT_SHADING if ignore_shading else MAX_RESIDUAL_RATIO) * now
    steps = [max(1, round(distance / pixel)) for distance in config.propagation_px]
    proposals = _Proposals(start, max(steps), extrapolate=ignore_shading)
    places = [(step * right, step * down) for step in steps for right, down in DIRECTIONS]
    # Launches are what takes time, but all neighbours together may be too much for a processor's cache.
    at_once = len(places) if flow.is_cuda else max(1, CACHED_PX // start[:, 0].numel())
    for i in range(0, len(places), at_once):
        proposed = proposals(places[i : i + at_once])
        left, which = residuals(proposed).min(dim=0)
        found = proposed.gather(0, which.expand_as(start).unsqueeze(0))[0]
        best, least = torch.where(left < least, found, best), torch.minimum(left, least)
    if ignore_shading:
        # Var F1 + Var F2 is the mean of the variances of difference and sum.
        difference, total = (windowed_residual(best, image, second, window, True) for image in (first, -first))
        taken = taken & (difference < MAX_RESIDUAL_RATIO_WITHOUT_SHADING * (difference + total) / 2)
    return flow + resize_flow(torch.where(taken, best - start, 0.0), (height, width))


def windowed_residual(
    flow: Flow | None, image1: Images, image2: Images, window: SeparableFilter, ignore_shading: bool
) -> Tensor:
    """E at each pixel, (N, 1, H, W), of N flows of B pairs in turn; infinite where too little of a window is inside.

    Without a flow, that of images that do not move.
    """
    whole = window(torch.ones_like(image1[:1, :1]))
    if image1.is_cuda and ignore_shading:
        from gelflow.models import fused_registration as fused

        flow = torch.zeros_like(image1[:, :2]) if flow is None else flow
        return fused.spread(window(fused.residual_terms(flow, image1, image2)), whole, MIN_SHARE_INSIDE)
    if flow is None:
        counts, left = torch.ones_like(image1[:, :1]), image2 - image1
    else:
        image1, image2 = (i.expand(len(flow) // len(i), *i.shape).flatten(0, 1) for i in (image1, image2))
        counts = inside(flow)
        left = counts * (warp(image2, flow) - image1)
    squares = left.square().mean(dim=1, keepdim=True)
    sums = window(torch.cat([counts, squares, left] if ignore_shading else [counts, squares], dim=1))
    weight = sums[:, :1]
    spread = sums[:, 1:2] / weight
    if ignore_shading:
        spread = spread - (sums[:, 2:] / weight).square().mean(dim=1, keepdim=True)
    return torch.where(weight > MIN_SHARE_INSIDE * whole, spread, torch.inf)


class _Proposals:
    """Flows that neighbours propose to each pixel.

    Beyond the border, its pixels go on; `reach` is the largest step along an axis. Where extrapolated, by the slope of
    the smoothed flow.
    """

    def __init__(self, flow: Flow, reach: int, extrapolate: bool) -> None:
        self._size, self._reach, self._extrapolate = (flow.shape[-2], flow.shape[-1]), reach, extrapolate
        if extrapolate:
            flow = smoother(flow, SLOPE_WINDOW_PX)(flow)
            flow = torch.cat([flow, *torch.gradient(flow, dim=(-1, -2))], dim=1)
        self._padded = pad(flow, (reach,) * 4, mode="replicate")

    def __call__(self, places: Sequence[tuple[int, int]]) -> Tensor:
        """The proposals of the neighbours at steps (right, down): (N, B, 2, H, W)."""
        rows, columns = self._size
        near = torch.stack([
            self._padded[..., self._reach + down :, self._reach + right :][..., :rows, :columns]
            for right, down in places
        ])  # fmt: skip
        if not self._extrapolate:
            return near
        there, across, along = near.split(2, dim=2)
        right, down = _steps(tuple(places), near.dtype, near.device)
        return there - right * across - down * along


@cached
def _steps(places: tuple[tuple[int, int], ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """The steps as a tensor (2, N, 1, 1, 1, 1) that broadcasts over proposals."""
    return torch.tensor(places, dtype=dtype, device=device).T.reshape(2, -1, 1, 1, 1, 1)
