"""Decomposition loss (paper, eq. 3-6): the L1 norm of the parts of the flow's gradient by Helmholtz's theorem.

``L_dc = w ( |e_xx| + |e_yy| + lambda_theta 2 |e_xy| + lambda_zeta 2 |omega| )`` with the linear distortion rates
``e_xx = u_x``, ``e_yy = v_y``, the shear distortion rate ``e_xy = (u_y + v_x) / 2``, the rotation
``omega = (v_x - u_y) / 2`` and a weight w from the gradient of image 1. Forward differences, as in eq. 2; mean over
the pixels that have a right and a lower neighbour. Zero for every translation.

The weight (paper, eq. 6) is ``1 - exp(-beta ||grad I||_1)``, ``||grad I||_1 = |I_x| + |I_y|`` as a mean over colours of
an image in [0, 1]: strong on edges, none where there is no texture.
"""

import torch

from gelflow.arrays import Flow, Images, Mask, Scalar
from gelflow.ops.gradients import forward_differences


def decomposition_loss(flow: Flow, weight: Mask, lambda_theta: float, lambda_zeta: float) -> Scalar:
    """The decomposition loss at one scale; 0 for a single row or column, which has no such gradient.

    The flow (B, 2, H, W) is divided by the image's shorter side; the weight is (B, 1, H-1, W-1). `lambda_theta` and
    `lambda_zeta` weigh the shear distortion rate and the rotation.
    """
    across, down = forward_differences(flow)
    if across.numel() == 0:
        return flow.sum() * 0
    u_x, v_x = across.split(1, dim=1)
    u_y, v_y = down.split(1, dim=1)
    linear = u_x.abs() + v_y.abs()
    shear, rotation = (u_y + v_x).abs(), (v_x - u_y).abs()
    return (weight * (linear + lambda_theta * shear + lambda_zeta * rotation)).mean()


def regulariser_weight(image: Images, beta: float, least: float) -> Mask:
    """The weight, raised to at least `least`: (B, 1, H-1, W-1), at pixels that have a right and a lower neighbour."""
    across, down = forward_differences(image)
    fading = torch.exp(-beta * (across.abs() + down.abs()).mean(dim=1, keepdim=True))
    return (1 - fading).clamp(min=least)
