"""Local correlation against its definition."""

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from gelflow.ops.correlation import local_correlation


def by_definition(first: Tensor, second: Tensor, radius: int) -> Tensor:
    batch, channels, height, width = first.shape
    side = 2 * radius + 1
    costs = torch.zeros(batch, side * side, height, width, dtype=first.dtype)
    for b in range(batch):
        for row in range(height):
            for column in range(width):
                for dy in range(-radius, radius + 1):
                    for dx in range(-radius, radius + 1):
                        r, c = row + dy, column + dx
                        if 0 <= r < height and 0 <= c < width:
                            product = sum(first[b, k, row, column] * second[b, k, r, c] for k in range(channels))
                            costs[b, (dy + radius) * side + dx + radius, row, column] = product / channels
    return costs


@pytest.mark.parametrize(("size", "radius"), [((3, 4), 1), ((2, 5), 2), ((1, 1), 4)])
def test_it_is_the_mean_product_over_channels(size: tuple[int, int], radius: int) -> None:
    first, second = torch.rand(2, 2, 3, *size, dtype=torch.float64)
    # sums of three products of numbers below one, in another order: a few times 2^-53
    torch.testing.assert_close(
        local_correlation(first, second, radius), by_definition(first, second, radius), rtol=0, atol=1e-15
    )


def test_a_shifted_copy_correlates_best_at_its_shift() -> None:
    first = torch.randn(1, 64, 12, 14)
    second = torch.roll(first, shifts=(-2, 3), dims=(2, 3))  # second(row - 2, column + 3) = first(row, column)
    best = local_correlation(first, second, 4).argmax(dim=1)[:, 4:-4, 4:-4]
    assert torch.equal(best, torch.full_like(best, (-2 + 4) * 9 + 3 + 4))


def test_inputs_that_are_not_contiguous_give_the_same() -> None:
    first, second = torch.rand(2, 1, 4, 6, 5)
    turned = local_correlation(first.mT, second.mT, 2)
    assert torch.equal(turned, local_correlation(first.mT.contiguous(), second.mT.contiguous(), 2))


def test_gradients_agree_with_finite_differences() -> None:
    first, second = torch.rand(2, 2, 3, 4, 5, dtype=torch.float64)
    assert gradcheck(lambda a, b: local_correlation(a, b, 2), (first.requires_grad_(), second.requires_grad_()))
