"""Flow between images of any size by a trained network: resize, estimate, examine what tears, resize the flow back.

Where a flow tears, the flow back decides. A network that takes dots for their neighbours is wrong by a pitch in a
patch, at whose edge the flow jumps. That is a sign only, since a gel may slide or fold; so where a flow jumps, the flow
back W is estimated, too. Pixels that return more than 1 px beside their start belong to a patch that one of the two got
wrong. Both stories are told in full, V with its inverse and W with its inverse, and over these pixels of both images
the one with the smaller windowed residual (`gelflow.models.propagation`) is kept:

    sum E1(W^-1) + sum E2(W)  <  MAX_RESIDUAL_RATIO (sum E1(V) + sum E2(V^-1)).

Dots fit dots a pitch away, so that less evidence than that proves nothing; nor would a smoother flow, for a true one is
often the less smooth. Where both directions are wrong, nothing is gained.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.config import MINIMUM_SIDE, RegistrationConfig
from gelflow.errors import InputError
from gelflow.models import GelFlow
from gelflow.models.gelflow import check_shapes
from gelflow.models.propagation import windowed_residual
from gelflow.models.registration import registered
from gelflow.ops.gaussian import window_sums
from gelflow.ops.pyramid import resize_flow, resize_images
from gelflow.ops.warp import inside, positions, warp


def estimate_flow(
    model: GelFlow,
    image1: Images,
    image2: Images,
    size: tuple[int, int] | None = None,
    flow: Callable[[Images, Images], Flow] | None = None,
) -> Flow:
    """The flow from image 1 to image 2: ``I1(x) = I2(x + V(x))``, (B, 2, H, W) float32, px of the images, no gradient.

    Images are (B, 3, H, W) float32 in [0, 1]. The network is used on the device that it is on, in evaluation mode, and
    left as it was; `size`, rows and columns at which it works, is by default that to which its training images were
    resized (`GelFlow.image_size`), or where they were not, the given images'. `flow` is called in place of
    `GelFlow.flow`, such as a `RecordedNetwork` of the model. InputError for shapes that differ, sides below 64 px where
    no size is given, other than three colours, values that are not finite.
    """
    size = size or model.image_size
    if size is not None and min(size) < MINIMUM_SIDE:
        raise InputError(f"size {size[0]}x{size[1]}: each side must be at least {MINIMUM_SIDE} px")
    if size is None or image1.shape != image2.shape or image1.ndim != 4 or image1.shape[1] != 3:
        check_shapes(image1, image2)
    for name, image in (("image 1", image1), ("image 2", image2)):
        if not torch.isfinite(image).all():
            raise InputError(f"{name} holds NaN or infinite values; images must be finite, in [0, 1]")
    device = next(model.parameters()).device
    native = (image1.shape[-2], image1.shape[-1])
    inputs = [resize_images(image.to(device, torch.float32), size or native) for image in (image1, image2)]
    was_training = model.training
    model.eval()
    try:
        with torch.no_grad():
            estimate, settings, (first, second) = flow or model.flow, model.config.registration, inputs
            found = estimate(first, second)
            if settings is not None:
                found = consistent(found, first, second, estimate, settings)
            found = resize_flow(found, native)
    finally:
        model.train(was_training)
    return found.to(image1.device)


MAX_SLOPE, MAX_TORN_SHARE = 1.0, 0.01
"""A flow tears where its gradient is larger, and is examined if it tears in more than this share of the image."""
CLOSED_PX = 1.0
"""Distance from its start within which a pixel returns."""
WINDOW_PX = 8.0
"""Standard deviation of the residual's window."""
MAX_RESIDUAL_RATIO, NOISE = 0.7, 0.01
"""Less than this share of the residuals decides; to each of them, the variance of the camera's noise is added."""
FILLING_PX = (1.0, 4.0, 16.0, 64.0)
"""Standard deviations of the windows whose means fill what an inverse flow leaves open."""


def consistent(
    flow: Flow, image1: Images, image2: Images, estimate: Callable[[Images, Images], Flow], config: RegistrationConfig
) -> Flow:
    """The flow that `estimate` found for two images, with patches of the flow back where that one is right.

    `estimate` is called with the images of single pairs exchanged; inverse flows are registered as `config` says.
    """
    slope = torch.cat(torch.gradient(flow, dim=(-1, -2)), dim=1).norm(dim=1)
    torn = (slope > MAX_SLOPE).float().mean(dim=(1, 2)) > MAX_TORN_SHARE
    pairs = zip(torn.tolist(), flow.split(1), image1.split(1), image2.split(1), strict=True)
    return torch.cat([
        _chosen(there, estimate(second, first), first, second, config) if examined else there
        for examined, there, first, second in pairs
    ])  # fmt: skip


def _chosen(flow: Flow, back: Flow, image1: Images, image2: Images, config: RegistrationConfig) -> Flow:
    other = registered(inverse(back), image1, image2, config)
    open1, open2 = _open(flow, back), _open(back, flow)
    ours, theirs = _residuals(flow, other, image1, image2, open1)
    back_inverted = registered(inverse(flow), image2, image1, config)
    kept, exchanged = _residuals(back_inverted, back, image2, image1, open2)
    return torch.where(open1 & (theirs + exchanged < MAX_RESIDUAL_RATIO * (ours + kept)), other, flow)


def _open(flow: Flow, back: Flow) -> Tensor:
    """Whether a pixel leaves the image or does not return, (1, 1, H, W)."""
    closed = (flow + warp(back, flow)).norm(dim=1, keepdim=True) < CLOSED_PX
    return ~(closed & (inside(flow) > 0))


def _residuals(flow: Flow, other: Flow, image1: Images, image2: Images, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Sums of two flows' windowed residuals where both have one."""
    window = window_sums(flow, WINDOW_PX)
    one, two = (
        NOISE**2 + windowed_residual(each, image1, image2, window, ignore_shading=True) for each in (flow, other)
    )
    counts = counts & torch.isfinite(one + two)
    return one[counts].sum(), two[counts].sum()


def inverse(flow: Flow) -> Flow:
    """The flow back by which each pixel of image 1 returns: means over those that end nearest to a pixel.

    Where none ends, means over growing windows around it. `flow` is one pair's, (1, 2, H, W).
    """
    rows, columns = flow.shape[-2:]
    x, y = positions(flow).round().long().flatten(2)[0]
    hit = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    values = torch.cat([-flow, torch.ones_like(flow[:, :1])], dim=1).flatten(2)[..., hit]
    sums = flow.new_zeros(1, 3, rows * columns).index_add_(2, (y * columns + x)[hit], values).view(1, 3, rows, columns)
    found = sums
    for deviation in FILLING_PX:
        found = torch.where(found[:, 2:] > 0, found, window_sums(flow, deviation)(sums))
    return found[:, :2] / found[:, 2:].clamp(min=torch.finfo(flow.dtype).tiny)
