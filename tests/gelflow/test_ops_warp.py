"""Warping: pixel centres, direction of the flow, the border, the mask."""

import pytest
import torch
from torch.autograd import gradcheck
from waves import moved_pair, pixel_centres, press_flow, wave_image

from gelflow.ops.warp import inside, warp


@pytest.mark.parametrize("size", [(64, 80), (67, 51), (1, 1)])
def test_zero_flow_keeps_the_image(size: tuple[int, int]) -> None:
    image = wave_image(*pixel_centres(*size), seed=1)[None]
    # float64: the position is rounded to about 80 px * 2^-52, the image's slope is below 1 per px
    torch.testing.assert_close(warp(image, torch.zeros(1, 2, *size, dtype=torch.float64)), image, rtol=0, atol=1e-13)
    # float32: 80 px * 2^-24 = 5e-6 px at a slope below 0.3 per px
    torch.testing.assert_close(warp(image.float(), torch.zeros(1, 2, *size)), image.float(), rtol=0, atol=1.5e-6)


def test_integer_shift_moves_pixels_without_blur() -> None:
    image = torch.rand(1, 3, 20, 30, dtype=torch.float64)
    flow = torch.zeros(1, 2, 20, 30, dtype=torch.float64)
    flow[:, 0], flow[:, 1] = 3, -2
    warped = warp(image, flow)
    # warped(row, column) = image(row - 2, column + 3); rounding as above, slopes up to 1 per px
    torch.testing.assert_close(warped[..., 2:, :-3], image[..., :-2, 3:], rtol=0, atol=1e-12)


def test_half_pixel_is_the_mean_of_two() -> None:
    image = torch.rand(1, 1, 5, 8, dtype=torch.float64)
    flow = torch.zeros(1, 2, 5, 8, dtype=torch.float64)
    flow[:, 0] = 0.5
    expected = (image[..., :-1] + image[..., 1:]) / 2
    torch.testing.assert_close(warp(image, flow)[..., :-1], expected, rtol=0, atol=1e-12)


def test_the_border_is_repeated() -> None:
    image = torch.rand(1, 1, 4, 6, dtype=torch.float64)
    flow = torch.zeros(1, 2, 4, 6, dtype=torch.float64)
    flow[:, 0] = 100
    assert torch.equal(warp(image, flow), image[..., -1:].expand_as(image))


def test_the_true_flow_maps_image_2_onto_image_1() -> None:
    flow = press_flow(72, 96, 4.0)
    image1, image2 = moved_pair(flow, seed=2, shortest=16, longest=48)
    error = (warp(image2[None], flow[None])[0] - image1)[:, 6:-6, 6:-6].abs().max()
    # Bilinear interpolation errs by at most (|f_xx| + |f_yy|) / 8: 24 waves of 0.05 (2 pi / 16 px)^2 / 8
    assert error < 0.0232
    assert (image2 - image1).abs().max() > 0.15


def test_inside_keeps_all_pixels_of_a_still_image_and_drops_those_that_leave() -> None:
    flow = torch.zeros(1, 2, 7, 9)
    assert inside(flow).min() == 1
    flow[:, 0], flow[:, 1] = 2.0, -1.0
    expected = torch.ones(1, 1, 7, 9)
    expected[..., -2:] = 0
    expected[..., :1, :] = 0
    assert torch.equal(inside(flow), expected)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1e30])
def test_a_flow_that_is_not_finite_gives_nan_and_a_huge_one_the_border(value: float) -> None:
    """`grid_sample` crashes the process in the gradient for NaN; a training that diverges must not."""
    image = torch.rand(1, 3, 8, 9, requires_grad=True)
    flow = torch.zeros(1, 2, 8, 9)
    flow[0, 0, 4, 5] = value
    warped = warp(image, flow.requires_grad_())
    warped.sum().backward()
    assert torch.isnan(warped[0, :, 4, 5]).all() == (value != 1e30)
    assert torch.isfinite(warped).sum() == warped.numel() - 3 * (value != 1e30)
    if value == 1e30:
        assert torch.equal(warped[0, :, 4, 5], image[0, :, 4, -1])


def test_gradients_agree_with_finite_differences() -> None:
    random = torch.Generator().manual_seed(0)
    image = torch.rand(1, 2, 5, 6, generator=random, dtype=torch.float64, requires_grad=True)
    # 0.1 .. 0.9 px from every pixel centre, where bilinear interpolation has its kinks
    flow = 0.1 + 0.8 * torch.rand(1, 2, 5, 6, generator=random, dtype=torch.float64)
    assert gradcheck(warp, (image, flow.requires_grad_()))
