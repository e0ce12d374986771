"""Flow between images of any size by a trained network: resize, estimate, resize the flow back."""

from collections.abc import Callable

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


def estimate_flow(
    model: GelFlow,
    image1: Images,
    image2: Images,
    size: tuple[int, int] | None = None,
    flow: Callable[[Images, Images], Flow] | None = None,
) -> Flow:
    """The flow from image 1 to image 2: ``I1(x) = I2(x + V(x))``, (B, 2, H, W) float32, px of the images, no gradient.

    Images are (B, 3, H, W) float32 in [0, 1]. The network is used on the device that it is on, in evaluation mode, and
    left as it was. `size` is the rows and columns at which it works, by default `GelFlow.image_size`. Where that is
    None, all of `working_sizes` are tried, and each pair keeps the flow with the least mean of sigma or, where they
    differ much (DIFFERENT), the one that closes best. `flow` is called in place of `GelFlow.flow`, such as a
    `RecordedNetwork` of the model. InputError for shapes that differ, sides of `size` below 64 px or, without one, of
    the images below 16 px, other than three colours, values that are not finite.
    """
    size = size or model.image_size
    if size is not None and min(size) < MINIMUM_SIDE:
        raise InputError(f"size {size[0]}x{size[1]}: each side must be at least {MINIMUM_SIDE} px")
    check_shapes(image1, image2, least=1 if size else SMALLEST)
    for name, image in (("image 1", image1), ("image 2", image2)):
        if not torch.isfinite(image).all():
            raise InputError(f"{name} holds NaN or infinite values; images must be finite, in [0, 1]")
    device = next(model.parameters()).device
    native = (image1.shape[-2], image1.shape[-1])
    first, second = (image.to(device, torch.float32) for image in (image1, image2))
    sizes = working_sizes(*native) if size is None else [size]
    was_training = model.training
    model.eval()

    def flows(one: Images, other: Images) -> list[Flow]:
        """The flow from one image to the other at each size."""
        reduced = ((resize_images(one, size), resize_images(other, size)) for size in sizes)
        return [resize_flow((flow or model.flow)(*images), native) for images in reduced]

    try:
        with torch.no_grad():
            found = flows(first, second)
            best = found[0]
            if len(found) > 1:
                sigmas = [sized_sigma(each, first, second, size)[0] for each, size in zip(found, sizes, strict=True)]
                chosen = torch.stack(sigmas).mean(dim=(2, 3, 4)).argmin(dim=0)
                differ = _share_beyond(found[0] - found[1]) > DIFFERENT
                if differ.any():
                    missed = [
                        there + warp(back, there) for there, back in zip(found, flows(second, first), strict=True)
                    ]
                    chosen = torch.where(differ, torch.stack(list(map(_share_beyond, missed))).argmin(dim=0), chosen)
                best = torch.stack(found)[chosen, torch.arange(len(best))]
    finally:
        model.train(was_training)
    return best.to(image1.device)


def _share_beyond(difference: Flow) -> Tensor:
    """(B,) the share of the picture in which a difference of flows, px, is longer than `unknown_px`."""
    return (difference.norm(dim=1) > unknown_px(difference.shape[-2], difference.shape[-1])).float().mean(dim=(1, 2))
