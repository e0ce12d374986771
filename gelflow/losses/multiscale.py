"""Losses summed over scales (paper, eq. 11): ``L = sum_s lambda_s (L_ph + lambda_dc L_dc + lambda_df L_df)``.

The images of scale s are means over 2^s x 2^s blocks. Flows are in px of their scale, so a gradient of the flow means
the same at every scale. With `compare_at` = "image" every scale's flow is enlarged and compared on the images
themselves: averaged images hold no pattern at coarse scales, where the published loss prefers too little motion.
"""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images, Mask, Scalar
from gelflow.config import LossConfig
from gelflow.losses.photometric import appearance_loss
from gelflow.losses.regularisers import (
    decomposition_loss,
    deformation_loss,
    edge_aware_loss,
    regulariser_weight,
)
from gelflow.ops.pyramid import enlarge_flow, flow_pyramid, image_pyramid
from gelflow.ops.warp import inside, warp

SOFTNESS_PX = 0.01
"""e: below this error the loss turns from linear to quadratic."""


def endpoint_loss(flow: Flow, truth: Flow) -> Scalar:
    """Mean of ``sqrt(|V - V*|^2 + e^2) - e`` at one scale, px, differentiable at zero; 0 where nothing is known.

    Pixels that see no gel (NaN in the true flow) do not count; pixels whose point is hidden or outside in the other
    image do, since their true motion is known.
    """
    known = torch.isfinite(truth).all(dim=1, keepdim=True)
    squared = (flow - torch.where(known, truth, flow.detach())).square().sum(dim=1, keepdim=True)
    distance = torch.sqrt(squared + SOFTNESS_PX**2) - SOFTNESS_PX
    return (distance * known).sum() / known.sum().clamp(min=1)


def self_supervised_loss(
    flows: list[Flow], image1: Images, image2: Images, config: LossConfig, visible: Mask | None = None
) -> tuple[Scalar, dict[str, Tensor]]:
    """The paper's loss, or that of one of its comparisons, from the images (B, 3, H, W) in [0, 1] alone.

    Flows are for s = 0 .. n-1, finest first, (B, 2, ceil(H / 2^s), ceil(W / 2^s)), px of scale s; `lambda_s` has n
    entries. `visible`, (B, 1, H, W), is 0 where the photometric losses should not count beside what leaves the image.
    Returned are also the weighted parts "photometric", "smoothness" and "deformation", detached, which add up to the
    loss.
    """
    side = min(image1.shape[-2:])
    coarse = len(flows) if config.compare_at == "scale" else 1
    first, second = image_pyramid(image1, coarse), image_pyramid(image2, coarse)
    seen = None if visible is None else image_pyramid(visible, coarse)
    parts = dict.fromkeys(("photometric", "smoothness", "deformation"), flows[0].new_zeros(()))
    for scale, flow in enumerate(flows):
        share = config.lambda_s[scale]
        smooth_share = share if config.smoothness_s is None else config.smoothness_s[scale]
        place = 0 if config.compare_at == "image" else scale
        if place < scale and (share or smooth_share):
            flow = enlarge_flow(flow, scale, (image1.shape[-2], image1.shape[-1]))
        if share > 0:
            pixels = inside(flow) if seen is None else inside(flow) * seen[place]
            # A spline needs three pixels.
            warped = warp(second[place], flow, config.warping if min(flow.shape[-2:]) > 2 else "bilinear")
            loss = appearance_loss(first[place], warped, pixels, config.alpha)
            parts["photometric"] = parts["photometric"] + share * loss
        if smooth_share > 0:
            smooth, deformed = _regulariser(flow, first[place], config, side)
            parts["smoothness"] = parts["smoothness"] + smooth_share * smooth
            parts["deformation"] = parts["deformation"] + smooth_share * deformed
    return torch.stack(list(parts.values())).sum(), {name: value.detach() for name, value in parts.items()}


def _regulariser(flow: Flow, image: Images, config: LossConfig, side: int) -> tuple[Scalar, Scalar]:
    """Weighted smoothness and deformation loss of one flow on image 1 of its size."""
    zero = flow.new_zeros(())
    if config.smoothness != "helmholtz":
        order = 1 if config.smoothness == "first_order" else 2
        return config.lambda_dc * edge_aware_loss(flow / side, image, config.beta, order), zero
    weight = regulariser_weight(image, config.beta, config.least_weight)
    smooth = decomposition_loss(flow / side, weight, config.lambda_theta, config.lambda_zeta)
    deformed = config.lambda_df * deformation_loss(flow, weight) if config.lambda_df > 0 else zero
    return config.lambda_dc * smooth, deformed


def flow_loss(flows: list[Flow], truth: Flow, config: LossConfig) -> tuple[Scalar, dict[str, Tensor]]:
    """The endpoint loss at all scales, for training on the exact flow, and that of the finest alone as "endpoint".

    Both are in px, the latter detached. Scales have the weights `flow_s`, or `lambda_s` in its absence; flows are as
    for `self_supervised_loss`.
    """
    truths = flow_pyramid(truth, len(flows))
    shares = config.lambda_s if config.flow_s is None else config.flow_s
    losses = [endpoint_loss(flow, known) for flow, known in zip(flows, truths, strict=True)]
    total = torch.stack([share * loss for share, loss in zip(shares, losses, strict=True)]).sum()
    return total, {"endpoint": losses[0].detach()}
