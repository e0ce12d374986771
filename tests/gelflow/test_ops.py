"""Operations on images and flows: warping, splines, windows, derivatives, scales, correlation, cached tensors."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter1d, map_coordinates
from torch import Tensor
from torch.autograd import gradcheck
from waves import pixel_centres, wave_image

from gelflow.losses.regularisers import forward_differences, window_slopes
from gelflow.ops.cached import cached
from gelflow.ops.correlation import _by_blocks, _by_channels, _unfolded, local_correlation
from gelflow.ops.gaussian import interpolator, smoother, window_sums
from gelflow.ops.pyramid import enlarge_flow, flow_pyramid, halve_flow, image_pyramid
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import inside, positions, warp


def constant_flow(u: float, v: float, rows: int, columns: int) -> Tensor:
    return torch.tensor([u, v], dtype=torch.float64).view(1, 2, 1, 1).repeat(1, 1, rows, columns)


@pytest.mark.parametrize("size", [(64, 80), (67, 51), (1, 1)])
def test_zero_flow_keeps_the_image(size: tuple[int, int]) -> None:
    image, still = wave_image(*pixel_centres(*size), seed=1)[None], constant_flow(0, 0, *size)
    # float64: the position is rounded to about 80 px * 2^-52, the image's slope is below 1 per px
    torch.testing.assert_close(warp(image, still), image, rtol=0, atol=1e-13)
    # float32: 80 px * 2^-24 = 5e-6 px at a slope below 0.3 per px
    torch.testing.assert_close(warp(image.float(), still.float()), image.float(), rtol=0, atol=1.5e-6)


def test_shifts_of_whole_and_half_pixels_are_exact_and_what_leaves_is_not_inside() -> None:
    image = torch.rand(1, 3, 20, 30, dtype=torch.float64)
    # warped(row, column) = image(row - 2, column + 3); rounding as above, slopes up to 1 per px
    warped = warp(image, constant_flow(3, -2, 20, 30))
    torch.testing.assert_close(warped[..., 2:, :-3], image[..., :-2, 3:], rtol=0, atol=1e-12)
    mean = (image[..., :-1] + image[..., 1:]) / 2
    torch.testing.assert_close(warp(image, constant_flow(0.5, 0, 20, 30))[..., :-1], mean, rtol=0, atol=1e-12)
    border = image[..., -1:].expand_as(image)
    torch.testing.assert_close(warp(image, constant_flow(100, 0, 20, 30)), border, rtol=0, atol=1e-12)
    assert inside(constant_flow(0, 0, 7, 9)).min() == 1
    expected = torch.ones(1, 1, 7, 9, dtype=torch.float64)
    expected[..., -2:] = expected[..., :1, :] = 0
    assert torch.equal(inside(constant_flow(2, -1, 7, 9)), expected)


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
    first, second = torch.rand(2, 2, 3, 3, 4, generator=random, dtype=torch.float64)
    assert gradcheck(lambda a, b: local_correlation(a, b, 2), (first.requires_grad_(), second.requires_grad_()))


def test_the_spline_is_scipys_and_keeps_the_image_at_lowered_precision_too() -> None:
    image, flow = torch.rand(2, 1, 2, 17, 23, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    flow = 6 * flow - 3
    rows, columns = np.mgrid[:17, :23].astype(float)
    places = [np.clip(rows + flow[0, 1].numpy(), 0, 16), np.clip(columns + flow[0, 0].numpy(), 0, 22)]
    expected = [map_coordinates(channel, places, order=3, mode="mirror") for channel in image[0].numpy()]
    np.testing.assert_allclose(SplineImage(image).at(positions(flow))[0].numpy(), expected, rtol=0, atol=1e-12)
    image, still = torch.rand(2, 3, 9, 8), torch.zeros(2, 2, 9, 8)
    # float32: a matrix of condition 3 and its inverse, and places in an image of a few px.
    torch.testing.assert_close(warp(image, still, "spline"), image, rtol=0, atol=4e-6)
    with torch.autocast("cpu", torch.bfloat16):
        torch.testing.assert_close(warp(image, still, "spline"), image, rtol=0, atol=4e-6)
    far = warp(image, still + 100, "spline")
    torch.testing.assert_close(far, image[..., -1:, -1:].expand_as(image), rtol=0, atol=4e-6)


def test_window_sums_are_a_convolution_and_smoothing_a_gaussian_up_to_the_border() -> None:
    field = torch.rand(2, 3, 21, 34, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = window_sums(field, 2.5)(field).numpy()
    expected = field.numpy()
    for axis in (-1, -2):
        # scipy's window ends at int(truncate * s + 0.5) px, ours at ceil(3 s) = 8, and has the sum one.
        height = sum(math.exp(-(k**2) / (2 * 2.5**2)) for k in range(-8, 9))
        expected = height * gaussian_filter1d(expected, 2.5, axis=axis, mode="constant", truncate=8 / 2.5)
    torch.testing.assert_close(torch.from_numpy(expected), torch.from_numpy(found), rtol=1e-12, atol=1e-12)
    y, x = torch.meshgrid(torch.arange(20.0).double(), torch.arange(30.0).double(), indexing="ij")
    field = torch.stack([3 + 0.2 * x - 0.1 * y, x * y])[None]
    # Both are affine along each axis. That of 8 px would reach beyond the other border.
    for deviation in (3.0, 8.0):
        torch.testing.assert_close(smoother(field, deviation)(field), field, rtol=1e-12, atol=1e-11)
    torch.testing.assert_close(smoother(field, 0.0)(field), field, rtol=0, atol=0)
    wave = torch.cos(0.4 * torch.arange(121.0, dtype=torch.float64)).expand(1, 1, 4, -1)
    found = smoother(wave, 2.0)(wave)
    # exp(-s² k² / 2) = 0.726; the window's end at 3 s leaves out 0.3 % of the Gaussian, as does the sum over pixels.
    torch.testing.assert_close(found[..., 20:-20], math.exp(-0.32) * wave[..., 20:-20], rtol=0, atol=5e-3)


@pytest.mark.parametrize("spacing", [1, 2, 3])
def test_window_sums_without_gradient_are_those_with_it_at_places_of_any_spacing(spacing: int) -> None:
    field = torch.rand(2, 3, 41, 34, generator=torch.Generator().manual_seed(0))
    window = window_sums(field, 4.0, spacing)
    # Sums of 10 to 100 in float32, in another order.
    torch.testing.assert_close(window(field), window(field.requires_grad_()).detach(), rtol=1e-5, atol=0)
    x = torch.arange(120.0, dtype=torch.float64)
    wave = torch.cos(0.3 * x).expand(1, 1, 120, -1)
    place = x[::spacing] + (spacing - 1) / 2
    # 2 pi s² exp(-s² k² / 2); each window's end at three deviations leaves out 0.3 % of 2 pi s².
    expected = 2 * math.pi * 16 * math.exp(-0.72) * torch.cos(0.3 * place)
    inner = slice(30 // spacing, 90 // spacing)
    found = window_sums(wave, 4.0, spacing)(wave)[0, 0, 60 // spacing, inner]
    torch.testing.assert_close(found, expected[inner], rtol=0, atol=2 * 0.003 * 2 * math.pi * 16)


def test_between_places_at_a_spacing_fields_are_interpolated_and_near_reads_the_splines_values() -> None:
    y, x = torch.meshgrid(torch.arange(40.0).double(), torch.arange(60.0).double(), indexing="ij")
    for spacing in (1, 2, 4):
        places = [axis[::spacing] + (spacing - 1) / 2 for axis in (y[:, 0], x[0])]
        wave = torch.cos(0.2 * places[0])[:, None] * torch.sin(0.1 * places[1])
        found = interpolator(y[None, None], spacing)(wave[None, None])
        # Keys' interpolation errs with the cube of the spacing: here (0.8)^3 / 24 at most, at the middle far less.
        torch.testing.assert_close(found[0, 0, 8:-8, 8:-8], (torch.cos(0.2 * y) * torch.sin(0.1 * x))[8:-8, 8:-8],
                                   rtol=0, atol=0.02)  # fmt: skip
    image = torch.rand(1, 2, 17, 23, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    spline, y, x = SplineImage(image), y[:17, :23], x[:17, :23]
    for quarter in (0.25, -0.25):
        at = torch.stack([x + quarter, y - quarter])[None]
        inner = (..., slice(1, -1), slice(1, -1))  # `at` repeats the border beyond the outer pixels' centres
        torch.testing.assert_close(spline.near(at)[inner], spline.at(at)[inner], rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [(3, 4), (17, 24)])
def test_opencvs_values_between_pixels_are_those_of_the_splines_matrices(size: tuple[int, int]) -> None:
    image = torch.rand(2, *size, 3, generator=torch.Generator().manual_seed(0)).movedim(-1, 1)
    exact = SplineImage(image.double())._quarters
    # The filter is cut where it has fallen to 1e-8, and its sums are rounded at 1e-7.
    torch.testing.assert_close(SplineImage(image)._quarters.double(), exact, rtol=0, atol=2e-6)


def test_both_orders_of_the_correlation_agree() -> None:
    first, second = torch.rand(2, 2, 3, 7, 45, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    expected = _unfolded(first, second, 2)
    for correlation in (_by_channels, _by_blocks):
        torch.testing.assert_close(correlation(first, second, 2), expected, rtol=0, atol=1e-12)


def test_derivatives_of_an_affine_field_are_exact_and_window_slopes_the_papers_least_squares() -> None:
    x, y = pixel_centres(6, 9)
    field = (0.7 * x - 0.2 * y + 3)[None, None]
    for derivative, size in ((forward_differences, (5, 8)), (window_slopes, (4, 7))):
        for found, slope in zip(derivative(field), (0.7, -0.2), strict=True):
            # values up to 10, rounded to 2^-50, differences divided by at most 1
            torch.testing.assert_close(found, torch.full((1, 1, *size), slope, dtype=torch.float64), rtol=0, atol=1e-13)
    assert forward_differences(torch.zeros(1, 2, 1, 5))[0].numel() == 0
    assert window_slopes(torch.zeros(1, 2, 2, 5))[0].numel() == 0
    flow = torch.randn(2, 7, 8, dtype=torch.float64)
    across, down = window_slopes(flow)
    offsets = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
    for row, column in itertools.product(range(1, 6), range(1, 7)):
        window = flow[:, row - 1 : row + 2, column - 1 : column + 2].reshape(2, 9) - flow[:, row, column, None]
        for k, (d, slopes) in enumerate(((offsets.repeat(3), across), (offsets.repeat_interleave(3), down))):
            # x' - x'_c = R_x (x - x_c): the one unknown of nine equations, by the pseudoinverse
            ratio = torch.linalg.lstsq(d[:, None], (d + window[k])[:, None]).solution.item()
            # nine values of size 1 in double precision
            assert abs(1 + slopes[k, row - 1, column - 1].item() - ratio) < 1e-13


def test_halving_averages_blocks_at_odd_borders_and_enlarging_keeps_a_linear_flow_linear() -> None:
    image = torch.rand(1, 3, 8, 12, dtype=torch.float64)
    # the mean of 16 numbers below one, in another order
    expected = image.view(1, 3, 2, 4, 3, 4).mean(dim=(3, 5))
    torch.testing.assert_close(image_pyramid(image, 3)[2], expected, rtol=0, atol=1e-15)
    assert image_pyramid(torch.tensor([[[[1.0, 3.0, 7.0]]]]), 2)[1].flatten().tolist() == [2.0, 7.0]
    for scale, coarse in enumerate(flow_pyramid(constant_flow(6, -4, 9, 7), 4)):
        assert torch.equal(coarse, constant_flow(6, -4, *coarse.shape[2:]) / 2**scale)
    flow = torch.ones(1, 2, 2, 4)
    flow[:, :, 0, 0] = torch.nan  # one of the first block's four
    flow[:, :, :, 2] = torch.nan  # two of the second's
    assert halve_flow(flow)[0, 0].tolist() == [[0.5, 0.5]]
    flow[:, :, 0, 3] = torch.nan
    assert torch.isnan(halve_flow(flow)[0, :, 0, 1]).all()
    columns = torch.arange(6, dtype=torch.float64) + 0.5
    flow = torch.stack([columns, -columns]).view(1, 2, 1, 6).expand(1, 2, 4, 6)
    fine = enlarge_flow(flow, 2, (15, 23))
    assert fine.shape == (1, 2, 15, 23)
    # u = x at the coarse scale, in coarse px, is u = x at the fine one in fine px; beyond the outermost coarse centres
    # (2 fine px from the border) bilinear enlargement repeats the border
    expected = torch.arange(23, dtype=torch.float64) + 0.5
    torch.testing.assert_close(fine[0, 0, 3, 2:21], expected[2:21], rtol=0, atol=1e-12)  # coordinates of size 24
    torch.testing.assert_close(fine[0, 1], -fine[0, 0])


def by_definition(first: Tensor, second: Tensor, radius: int) -> Tensor:
    batch, _, height, width = first.shape
    costs = torch.zeros(batch, (2 * radius + 1) ** 2, height, width, dtype=first.dtype)
    shifts = list(enumerate(itertools.product(range(-radius, radius + 1), repeat=2)))
    for b, (k, (dy, dx)), row, column in itertools.product(range(batch), shifts, range(height), range(width)):
        if 0 <= row + dy < height and 0 <= column + dx < width:
            costs[b, k, row, column] = (first[b, :, row, column] * second[b, :, row + dy, column + dx]).mean()
    return costs


@pytest.mark.parametrize(("size", "radius"), [((3, 4), 1), ((2, 5), 2), ((1, 1), 4)])
def test_it_is_the_mean_product_over_channels(size: tuple[int, int], radius: int) -> None:
    first, second = torch.rand(2, 2, 3, *size, dtype=torch.float64)
    expected = by_definition(first, second, radius)
    # sums of three products of numbers below one, in another order: a few times 2^-53
    torch.testing.assert_close(local_correlation(first, second, radius), expected, rtol=0, atol=1e-15)
    turned = local_correlation(first.mT, second.mT, radius)  # not contiguous
    assert torch.equal(turned, local_correlation(first.mT.contiguous(), second.mT.contiguous(), radius))


def test_cached_tensors_are_made_once_and_take_part_in_training_even_if_made_in_inference_mode() -> None:
    made: list[int] = []

    @cached
    def twos(pixels: int, dtype: torch.dtype) -> Tensor:
        made.append(pixels)
        return torch.full((pixels,), 2.0, dtype=dtype)

    with torch.inference_mode():
        assert twos(3, torch.float32) is twos(3, torch.float32)
    assert twos(3, torch.float64).dtype == torch.float64
    assert made == [3, 3]
    x = torch.ones(3, requires_grad=True)
    (twos(3, torch.float32) * x).sum().backward()  # autograd refuses to save what inference mode made
    assert x.grad.tolist() == [2.0, 2.0, 2.0]
