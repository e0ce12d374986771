"""Derivatives of affine fields are exact; R_x and R_y of the paper are 1 + Prewitt / 6."""

import torch
from waves import pixel_centres

from gelflow.ops.gradients import forward_differences, window_slopes


def test_both_derivatives_are_exact_for_an_affine_field() -> None:
    x, y = pixel_centres(6, 9)
    field = (0.7 * x - 0.2 * y + 3)[None, None]
    for derivative, size in ((forward_differences, (5, 8)), (window_slopes, (4, 7))):
        across, down = derivative(field)
        assert across.shape == down.shape == (1, 1, *size)
        # values up to 10, rounded to 2^-50, differences divided by at most 1
        torch.testing.assert_close(across, torch.full_like(across, 0.7), rtol=0, atol=1e-13)
        torch.testing.assert_close(down, torch.full_like(down, -0.2), rtol=0, atol=1e-13)


def test_one_plus_the_window_slope_is_the_least_squares_ratio_of_the_paper() -> None:
    flow = torch.randn(2, 7, 8, dtype=torch.float64)
    slope_x, slope_y = window_slopes(flow)
    offsets = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    dx, dy = offsets.repeat(3), offsets.repeat_interleave(3)
    for row in range(1, 6):
        for column in range(1, 7):
            window = flow[:, row - 1 : row + 2, column - 1 : column + 2].reshape(2, 9) - flow[:, row, column, None]
            # x' - x'_c = R_x (x - x_c): the one unknown of nine equations, by the pseudoinverse
            ratio_x = torch.linalg.lstsq(dx[:, None], (dx + window[0])[:, None]).solution.item()
            ratio_y = torch.linalg.lstsq(dy[:, None], (dy + window[1])[:, None]).solution.item()
            # nine values of size 1 in double precision
            assert abs(1 + slope_x[0, row - 1, column - 1].item() - ratio_x) < 1e-13
            assert abs(1 + slope_y[1, row - 1, column - 1].item() - ratio_y) < 1e-13


def test_fields_that_are_too_small_have_no_derivative() -> None:
    assert forward_differences(torch.zeros(1, 2, 1, 5))[0].numel() == 0
    assert window_slopes(torch.zeros(1, 2, 2, 5))[0].numel() == 0
