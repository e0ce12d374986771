"""Elastic deformation loss (paper, eq. 7-9): the ratio by which the flow changes areas should vary little in space.

``L_df = w |grad R|_1``. R_x and R_y are the least-squares slopes of the warped positions x' = x + u and y' = y + v
over 3x3 windows, which is exactly ``R_x = 1 + Prewitt_x(u) / 6``, ``R_y = 1 + Prewitt_y(v) / 6``. Published:
``R = R_x R_y``, which rotations change, unlike the true ratio of areas. It is constant, and the loss zero, for every
affine flow.
"""

from torch import Tensor

from gelflow.arrays import Flow, Mask, Scalar
from gelflow.ops.gradients import forward_differences, window_slopes


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
