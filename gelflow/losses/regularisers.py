"""What keeps the flow of a scale smooth: the losses of the paper, and the edge-aware smoothness of others.

Decomposition loss (paper, eq. 3-6): the L1 norm of the parts of the flow's gradient by Helmholtz's theorem.

``L_dc = w ( |e_xx| + |e_yy| + lambda_theta 2 |e_xy| + lambda_zeta 2 |omega| )`` with the linear distortion rates
``e_xx = u_x``, ``e_yy = v_y``, the shear distortion rate ``e_xy = (u_y + v_x) / 2``, the rotation
``omega = (v_x - u_y) / 2`` and a weight w from the gradient of image 1. Zero for every translation.

The weight (paper, eq. 6) is ``1 - exp(-beta ||grad I||_1)``, ``||grad I||_1 = |I_x| + |I_y|`` as a mean over colours of
an image in [0, 1]: strong on edges, none where there is no texture.

Elastic deformation loss (paper, eq. 7-9): the ratio by which the flow changes areas should vary little in space.

``L_df = w |grad R|_1``. R_x and R_y are the least-squares slopes of the warped positions x' = x + u and y' = y + v
over 3x3 windows, which is exactly ``R_x = 1 + Prewitt_x(u) / 6``, ``R_y = 1 + Prewitt_y(v) / 6``. Published:
``R = R_x R_y``, which rotations change, unlike the true ratio of areas. It is constant, and the loss zero, for every
affine flow.

Edge-aware smoothness as lliuz/ARFlow has it (losses/loss_blocks.py), of first order the regulariser of the paper's
comparison "SelfFlow", of second that of ARFlow. Each mean is over u and v and all pixels that have the derivative:

``L_1 = ( mean[ exp(-beta |I_x|) |V_x| ] + mean[ exp(-beta |I_y|) |V_y| ] ) / 4``,
``L_2 = ( mean[ exp(-beta |I_x|) |V_xx| ] + mean[ exp(-beta |I_y|) |V_yy| ] ) / 2``,

|I_x| as a mean over colours, for L_2 from the pixel around which V is differentiated to the next. L_1 is zero for every
translation, L_2 for every affine flow. L_1 is halved twice there, which UFlow does not do.

No value is invented beyond the border. The paper's forward differences (eq. 2) live on the (H-1) x (W-1) pixels that
have a right and a lower neighbour, least-squares slopes over 3x3 windows on the (H-2) x (W-2) pixels that have all
eight.
"""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images, Mask, Scalar


def forward_differences(field: Tensor) -> tuple[Tensor, Tensor]:
    """Differences to the right and to the lower neighbour, per px, each (..., H-1, W-1); empty where a side is 1."""
    here = field[..., :-1, :-1]
    return field[..., :-1, 1:] - here, field[..., 1:, :-1] - here


def window_slopes(field: Tensor) -> tuple[Tensor, Tensor]:
    """Slopes d/dx and d/dy, per px, each (..., H-2, W-2), of the plane that fits each 3x3 window best in least squares.

    That is Prewitt / 6; exact for an affine field, empty where a side is below 3.
    """
    across = field[..., :, 2:] - field[..., :, :-2]
    down = field[..., 2:, :] - field[..., :-2, :]
    slope_x = (across[..., :-2, :] + across[..., 1:-1, :] + across[..., 2:, :]) / 6
    slope_y = (down[..., :, :-2] + down[..., :, 1:-1] + down[..., :, 2:]) / 6
    return slope_x, slope_y


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


def area_ratio(flow: Flow) -> Tensor:
    """R at the pixels that have all eight neighbours, (B, 1, H-2, W-2); 1 where nothing is stretched."""
    slope_x, slope_y = window_slopes(flow)
    return (1 + slope_x[:, :1]) * (1 + slope_y[:, 1:])


def deformation_loss(flow: Flow, weight: Mask) -> Scalar:
    """The deformation loss at one scale, the mean over pixels; 0 for fewer than 4x4 px, which have no gradient of R.

    The flow (B, 2, H, W) is in px of this scale, never divided by the image's size: R is a ratio of lengths. Of the
    weight (B, 1, H-1, W-1) the part that belongs to the centres of R is used.
    """
    if min(flow.shape[-2:]) < 4:
        return flow.sum() * 0
    across, down = forward_differences(area_ratio(flow))
    return (weight[..., 1:-1, 1:-1] * (across.abs() + down.abs())).mean()


def edge_aware_loss(flow: Flow, image: Images, beta: float, order: int) -> Scalar:
    """The edge-aware smoothness of order 1 or 2 at one scale; 0 where a side of the image has no such derivative.

    The flow is in px or divided by the image's shorter side; `beta` is the weight's steepness in the image gradient.
    """
    if min(flow.shape[-2:]) <= order:
        return flow.sum() * 0
    means = []
    for axis in (-1, -2):
        derivative = flow.diff(n=order, dim=axis)
        step = image.diff(dim=axis).narrow(axis, order - 1, derivative.shape[axis])
        means.append((torch.exp(-beta * step.abs().mean(dim=1, keepdim=True)) * derivative.abs()).mean())
    return (means[0] + means[1]) / (4 if order == 1 else 2)
