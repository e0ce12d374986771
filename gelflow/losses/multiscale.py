"""Losses summed over scales (paper, eq. 11): ``L = sum_s lambda_s (L_ph + lambda_dc L_dc + lambda_df L_df)``.

The images of scale s are means over 2^s x 2^s blocks. Flows are in px of their scale, so a gradient of the flow means
the same at every scale.
"""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images, Scalar
from gelflow.config import LossConfig
from gelflow.losses.decomposition import decomposition_loss
from gelflow.losses.deformation import deformation_loss
from gelflow.losses.endpoint import endpoint_loss
from gelflow.losses.photometric import photometric_loss
from gelflow.losses.smoothness import first_order_loss
from gelflow.losses.weight import regulariser_weight
from gelflow.ops.pyramid import flow_pyramid, image_pyramid


def self_supervised_loss(
    flows: list[Flow], image1: Images, image2: Images, config: LossConfig
) -> tuple[Scalar, dict[str, Tensor]]:
    """The paper's loss, or that of its comparison SelfFlow, from the images alone.

    Args:
        flows: For s = 0 .. n-1, finest first, (B, 2, ceil(H / 2^s), ceil(W / 2^s)), px of scale s.
        image1: (B, 3, H, W) in [0, 1].
        image2: The same shape.
        config: Weights; `lambda_s` has n entries.

    Returns:
        The loss, and its weighted parts "photometric", "smoothness" and "deformation", detached, which add up to it.
    """
    side = min(image1.shape[-2:]) if config.flow_normalisation == "min_side" else 1
    first, second = image_pyramid(image1, len(flows)), image_pyramid(image2, len(flows))
    zero = flows[0].new_zeros(())
    photometric, smoothness, deformation = zero, zero, zero
    for scale, flow in enumerate(flows):
        share = config.lambda_s[scale]
        if share == 0:
            continue
        photometric = photometric + share * photometric_loss(
            first[scale], second[scale], flow, config.alpha, config.mask_outside
        )
        if config.smoothness == "first_order":
            smooth = first_order_loss(flow / side, first[scale], config.beta)
            smoothness = smoothness + share * config.lambda_dc * smooth
        elif config.smoothness == "helmholtz":
            weight = regulariser_weight(first[scale], config.weight, config.beta, config.weight_floor)
            smooth = decomposition_loss(flow / side, weight, config.lambda_theta, config.lambda_zeta)
            smoothness = smoothness + share * config.lambda_dc * smooth
            if config.lambda_df > 0:
                deformed = deformation_loss(flow, weight, config.ratio)
                deformation = deformation + share * config.lambda_df * deformed
    parts = {"photometric": photometric, "smoothness": smoothness, "deformation": deformation}
    return photometric + smoothness + deformation, {name: value.detach() for name, value in parts.items()}


def flow_loss(flows: list[Flow], truth: Flow, config: LossConfig) -> tuple[Scalar, dict[str, Tensor]]:
    """The endpoint loss at all scales, for training on the exact flow.

    Args:
        flows: As for `self_supervised_loss`.
        truth: (B, 2, H, W), px; NaN where the pixel sees no gel.
        config: Only `lambda_s` matters.

    Returns:
        The loss, and its part "endpoint": the loss of the finest scale alone, px, detached.
    """
    truths = flow_pyramid(truth, len(flows))
    losses = [endpoint_loss(flow, known) for flow, known in zip(flows, truths, strict=True)]
    total = torch.stack([share * loss for share, loss in zip(config.lambda_s, losses, strict=True)]).sum()
    return total, {"endpoint": losses[0].detach()}
