"""Derivatives on the pixel grid, valid part only: no value is invented beyond the border.

Forward differences live on the (H-1) x (W-1) pixels that have a right and a lower neighbour; least-squares slopes over
3x3 windows (the Prewitt operator over 6) on the (H-2) x (W-2) pixels that have all eight.
"""

from torch import Tensor


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
