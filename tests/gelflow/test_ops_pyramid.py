"""Scales halve exactly, whatever the size; flows change their unit with them."""

import pytest
import torch

from gelflow.ops.pyramid import enlarge_flow, flow_pyramid, halve_flow, image_pyramid


@pytest.mark.parametrize("size", [(64, 64), (240, 320), (67, 101)])
def test_sizes_are_halved_and_rounded_up(size: tuple[int, int]) -> None:
    sizes = [tuple(image.shape[-2:]) for image in image_pyramid(torch.zeros(1, 3, *size), 7)]
    assert sizes == [(-(-size[0] // 2**s), -(-size[1] // 2**s)) for s in range(7)]


def test_an_image_is_averaged_over_blocks() -> None:
    image = torch.rand(1, 3, 8, 12, dtype=torch.float64)
    # the mean of 16 numbers below one, in another order
    expected = image.view(1, 3, 2, 4, 3, 4).mean(dim=(3, 5))
    torch.testing.assert_close(image_pyramid(image, 3)[2], expected, rtol=0, atol=1e-15)


def test_an_odd_last_column_stands_for_itself() -> None:
    image = torch.tensor([[1.0, 3.0, 7.0]]).view(1, 1, 1, 3)
    assert image_pyramid(image, 2)[1].flatten().tolist() == [2.0, 7.0]


def test_a_constant_flow_is_halved_in_px_also_at_odd_borders() -> None:
    flow = torch.tensor([6.0, -4.0]).view(1, 2, 1, 1).expand(1, 2, 9, 7)
    for scale, coarse in enumerate(flow_pyramid(flow, 4)):
        expected = torch.tensor([6.0, -4.0]).view(1, 2, 1, 1) / 2**scale
        assert torch.equal(coarse, expected.expand_as(coarse))


def test_unknown_flow_is_left_out_of_the_mean_and_spreads_only_where_it_prevails() -> None:
    flow = torch.ones(1, 2, 2, 4)
    flow[:, :, 0, 0] = torch.nan  # one of the first block's four
    flow[:, :, :, 2] = torch.nan  # two of the second's
    assert halve_flow(flow)[0, 0].tolist() == [[0.5, 0.5]]
    flow[:, :, 0, 3] = torch.nan
    assert torch.isnan(halve_flow(flow)[0, :, 0, 1]).all()


def test_enlarging_multiplies_values_and_keeps_a_linear_flow_linear() -> None:
    columns = torch.arange(6, dtype=torch.float64) + 0.5
    flow = torch.stack([columns, -columns]).view(1, 2, 1, 6).expand(1, 2, 4, 6)
    fine = enlarge_flow(flow, 2, (15, 23))
    assert fine.shape == (1, 2, 15, 23)
    # u = x at the coarse scale, in coarse px, is u = x at the fine one in fine px; beyond the outermost coarse centres
    # (2 fine px from the border) bilinear enlargement repeats the border
    expected = torch.arange(23, dtype=torch.float64) + 0.5
    torch.testing.assert_close(fine[0, 0, 3, 2:21], expected[2:21], rtol=0, atol=1e-12)  # coordinates of size 24
    torch.testing.assert_close(fine[0, 1], -fine[0, 0])
