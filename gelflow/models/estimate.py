"""Flow between images of any size by a trained network: resize, estimate, resize the flow back."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.config import MINIMUM_SIDE
from gelflow.errors import InputError
from gelflow.files.image import MINIMUM_SIDE as SMALLEST
from gelflow.models import GelFlow
from gelflow.models.gelflow import check_shapes
from gelflow.models.working_size import sized_sigma, unknown_px, working_sizes
from gelflow.ops.pyramid import resize_flow, resize_images
from gelflow.ops.warp import warp

DIFFERENT = 0.1
"""Share of the picture on which the flows at two sizes may differ. Where they differ on more, one of them may have
taken dots for their neighbours, which sigma does not tell. Then the flow that closes on more of the picture is kept."""


Found = TypeVar("Found")
Run = Callable[..., tuple[Tensor, ...]]
"""Calls a function with arguments, such as `gelflow.models.recorded.Recorder`."""


def estimate_flow(
    model: GelFlow, image1: Images, image2: Images, size: tuple[int, int] | None = None, run: Run | None = None
) -> Flow:
    """The flow from image 1 to image 2: ``I1(x) = I2(x + V(x))``, (B, 2, H, W) float32, px of the images, no gradient.

    Images are (B, 3, H, W) float32 in [0, 1]. The network is used on the device that it is on, in evaluation mode, and
    left as it was. `size` is the rows and columns at which it works, by default `GelFlow.image_size`. Where that is
    None, all of `working_sizes` are tried, and each pair keeps the flow with the least mean of sigma or, where they
    differ much (DIFFERENT), the one that closes best. InputError for shapes that differ, sides of `size` below 64 px
    or, without one, of the images below 16 px, other than three colours, values that are not finite.
    """
    size = size or model.image_size
    if size is not None and min(size) < MINIMUM_SIDE:
        raise InputError(f"size {size[0]}x{size[1]}: each side must be at least {MINIMUM_SIDE} px")
    check_shapes(image1, image2, least=1 if size else SMALLEST)
    device, run = next(model.parameters()).device, run or _call
    first, second = (image.to(device, torch.float32) for image in (image1, image2))
    # Of values some of which are NaN, so are least and largest. A device is waited for once.
    finite = torch.stack([*first.aminmax(), *second.aminmax()]).isfinite().tolist()
    if not all(finite):
        number = 1 + finite.index(False) // 2
        raise InputError(f"image {number} holds NaN or infinite values; images must be finite, in [0, 1]")
    sizes = tuple(working_sizes(image1.shape[-2], image1.shape[-1]) if size is None else [size])
    was_training = model.training
    model.eval()
    try:
        with torch.no_grad():
            if len(sizes) == 1:
                best = run(flows_at, model, sizes, first, second)[0]
            else:
                *found, chosen, differ = run(_surest, model, sizes, first, second)
                if differ.any():
                    backward = run(flows_at, model, sizes, second, first)
                    missed = [
                        _share_beyond(there + warp(back, there)) for there, back in zip(found, backward, strict=True)
                    ]
                    chosen = torch.where(differ, torch.stack(missed).argmin(dim=0), chosen)
                best = torch.stack(found)[chosen, torch.arange(len(chosen), device=device)]
    finally:
        model.train(was_training)
    return best.to(image1.device)


def _call(function: Run, *arguments: Any) -> tuple[Tensor, ...]:
    return function(*arguments)


def flows_at(model: GelFlow, sizes: Sequence[tuple[int, int]], image1: Images, image2: Images) -> tuple[Flow, ...]:
    """The flow at each size, px of the images as they are given."""
    return tuple(_side_by_side([partial(_flow_at, model, size, image1, image2) for size in sizes], image1.is_cuda))


def _flow_at(model: GelFlow, size: tuple[int, int], image1: Images, image2: Images) -> Flow:
    reduced = model.flow(resize_images(image1, size), resize_images(image2, size))
    return resize_flow(reduced, (image1.shape[-2], image1.shape[-1]))


def _side_by_side(calls: Sequence[Callable[[], Found]], cuda: bool) -> list[Found]:
    """What calls give. A GPU, of which the kernels of one leave most idle, makes them at once, on streams."""
    if not cuda:
        return [call() for call in calls]
    here, asides = torch.cuda.current_stream(), [torch.cuda.Stream() for _ in calls[1:]]
    found = []
    for call, aside in zip(calls[1:], asides, strict=True):
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            found.append(call())
    found.insert(0, calls[0]())
    for aside in asides:
        here.wait_stream(aside)
    return found


def _surest(model: GelFlow, sizes: Sequence[tuple[int, int]], image1: Images, image2: Images) -> tuple[Tensor, ...]:
    """The flow at each of two sizes; per pair, which one has the least mean of sigma, and whether they differ much."""

    def at(size: tuple[int, int]) -> tuple[Flow, Tensor]:
        flow = _flow_at(model, size, image1, image2)
        return flow, sized_sigma(flow, image1, image2, size)[0]

    flows, sigmas = zip(*_side_by_side([partial(at, size) for size in sizes], image1.is_cuda), strict=True)
    chosen = torch.stack(sigmas).mean(dim=(2, 3, 4)).argmin(dim=0)
    return *flows, chosen, _share_beyond(flows[0] - flows[1]) > DIFFERENT


def _share_beyond(difference: Flow) -> Tensor:
    """(B,) the share of the picture in which a difference of flows, px, is longer than `unknown_px`."""
    return (difference.norm(dim=1) > unknown_px(difference.shape[-2], difference.shape[-1])).float().mean(dim=(1, 2))
