"""Local flow fusion: convex, exact for constant flows up to the border, scaled as configured."""

import pytest
import torch
from torch.autograd import gradcheck

from gelflow.models.lffm import LocalFlowFusion


@pytest.mark.parametrize("region", [3, 5])
@pytest.mark.parametrize("scale", ["inverse_sqrt", "none"])
def test_weights_are_a_softmax_over_the_neighbours_inside(region: int, scale: str) -> None:
    context = torch.randn(2, 8, 6, 7, dtype=torch.float64)
    weights = LocalFlowFusion(region, scale).weights(context)
    # a softmax of at most 25 terms in double precision
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(2, 6, 7, dtype=torch.float64), rtol=0, atol=1e-14)
    radius, factor = region // 2, 8**-0.5 if scale == "inverse_sqrt" else 1.0
    row, column = 0, 5
    logits = {}
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            if 0 <= row + dy < 6 and 0 <= column + dx < 7:
                product = (context[0, :, row, column] * context[0, :, row + dy, column + dx]).sum().item()
                logits[(dy + radius) * region + dx + radius] = factor * product
    expected = torch.zeros(region**2, dtype=torch.float64)
    expected[list(logits)] = torch.softmax(torch.tensor(list(logits.values()), dtype=torch.float64), dim=0)
    torch.testing.assert_close(weights[0, :, row, column], expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("region", [3, 5])
def test_a_constant_flow_stays_as_it_is_up_to_the_border(region: int) -> None:
    flow = torch.tensor([3.0, -1.5], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, 5, 8)
    fused = LocalFlowFusion(region, "inverse_sqrt")(flow, torch.randn(1, 32, 5, 8, dtype=torch.float64))
    # weights sum to one within 1e-14, times 3 px
    torch.testing.assert_close(fused, flow, rtol=0, atol=1e-13)


def test_a_fused_flow_lies_between_its_neighbours() -> None:
    flow = torch.randn(1, 2, 9, 9, dtype=torch.float64)
    fused = LocalFlowFusion(3, "inverse_sqrt")(flow, torch.randn(1, 32, 9, 9, dtype=torch.float64))
    upper = torch.nn.functional.max_pool2d(flow, 3, 1, 1)
    lower = -torch.nn.functional.max_pool2d(-flow, 3, 1, 1)
    assert (fused <= upper + 1e-12).all()  # sums of nine numbers of size 1
    assert (fused >= lower - 1e-12).all()
    assert (fused - flow).abs().max() > 0.1


def test_unscaled_products_of_long_features_select_the_centre() -> None:
    # Independent features of variance 1/4: the centre's product is C/4 on average, its neighbours' 0 +- sqrt(C)/4. With
    # C = 128 the centre leads by 32 unscaled, and by 2.8 scaled, where eight neighbours share 8 / (8 + e^2.8) = 0.33.
    context = 0.5 * torch.randn(1, 128, 40, 40, generator=torch.Generator().manual_seed(0))
    centre = {kind: LocalFlowFusion(3, kind).weights(context)[:, 4].mean().item() for kind in ("inverse_sqrt", "none")}
    assert centre["none"] > 0.99
    assert 0.5 < centre["inverse_sqrt"] < 0.8


def test_gradients_agree_with_finite_differences() -> None:
    flow, context = torch.randn(1, 2, 3, 4, dtype=torch.float64), torch.randn(1, 3, 3, 4, dtype=torch.float64)
    assert gradcheck(LocalFlowFusion(3, "inverse_sqrt"), (flow.requires_grad_(), context.requires_grad_()))
