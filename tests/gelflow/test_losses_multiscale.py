"""The sum over scales, the endpoint loss, and their configuration."""

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck
from waves import moved_pair, press_flow

from gelflow.config import LossConfig
from gelflow.losses import flow_loss, self_supervised_loss
from gelflow.losses.endpoint import SOFTNESS_PX, endpoint_loss
from gelflow.ops.pyramid import flow_pyramid

CONFIGS = [
    LossConfig(),
    LossConfig(smoothness="first_order"),
    LossConfig(ratio="det", weight="edge_aware"),
    LossConfig(weight="floor"),
    LossConfig(lambda_dc=0, lambda_df=0),
]


@pytest.fixture(scope="module")
def pressed() -> tuple[Tensor, Tensor, Tensor]:
    """True flow, up to 8 px, and both images, 240 x 320 px."""
    flow = press_flow(240, 320, 8.0)
    image1, image2 = moved_pair(flow, seed=5)
    return flow[None], image1[None], image2[None]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: f"{config.smoothness}-{config.weight}")
def test_the_true_flow_scores_better_than_none(config: LossConfig, pressed: tuple[Tensor, Tensor, Tensor]) -> None:
    flow, image1, image2 = pressed
    losses = [self_supervised_loss([f * v for v in flow_pyramid(flow, 7)], image1, image2, config)[0] for f in (0, 1)]
    assert losses[1] < 0.75 * losses[0]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: f"{config.smoothness}-{config.weight}")
def test_the_true_flow_scores_better_than_a_tenth_more_or_less(
    config: LossConfig, pressed: tuple[Tensor, Tensor, Tensor]
) -> None:
    """At the scales that resolve the texture (s = 0, 1, 2). At coarser ones, the published loss itself prefers too
    little motion: the pattern is averaged away, and the regulariser is what is left.
    """
    flow, image1, image2 = pressed
    config = config.model_copy(update={"lambda_s": (1.0, 1.0, 1.0)})
    flows = flow_pyramid(flow, 3)
    losses = [self_supervised_loss([f * v for v in flows], image1, image2, config)[0] for f in (0.9, 1, 1.1)]
    assert losses[1] < min(losses[0], losses[2])


def test_without_normalisation_no_flow_scores_better_than_the_true_one(pressed: tuple[Tensor, Tensor, Tensor]) -> None:
    """The trap that `flow_normalisation` avoids: lambda_dc = 75 acting on px."""
    flow, image1, image2 = pressed
    flows, still = flow_pyramid(flow, 7), flow_pyramid(0 * flow, 7)
    config = LossConfig(flow_normalisation="none")
    assert (
        self_supervised_loss(flows, image1, image2, config)[0] > self_supervised_loss(still, image1, image2, config)[0]
    )


def test_parts_add_up_and_scales_are_weighted() -> None:
    flow = torch.randn(1, 2, 64, 64, dtype=torch.float64)
    image1, image2 = torch.rand(2, 1, 3, 64, 64, dtype=torch.float64)
    flows = flow_pyramid(flow, 3)

    def total(*weights: float) -> Tensor:
        loss, parts = self_supervised_loss(flows, image1, image2, LossConfig(lambda_s=weights))
        # a sum of three numbers of size one
        assert abs(sum(parts.values()) - loss) < 1e-14
        return loss

    separate = 2 * total(1, 0, 0) + total(0, 1, 0) + 0.5 * total(0, 0, 1)
    assert abs(total(2, 1, 0.5) - separate) < 1e-13


def test_selfflow_leaves_out_the_deformation_loss() -> None:
    flows = flow_pyramid(torch.randn(1, 2, 64, 64), 3)
    images = torch.rand(2, 1, 3, 64, 64)
    for smoothness, present in (("helmholtz", True), ("first_order", False)):
        config = LossConfig(smoothness=smoothness, lambda_s=(1, 1, 1))
        assert bool(self_supervised_loss(flows, *images, config)[1]["deformation"]) == present


def test_every_scale_of_the_smallest_image_has_a_gradient() -> None:
    images = torch.rand(2, 1, 3, 64, 64)
    flows = [torch.randn(1, 2, 64 >> s, 64 >> s).mul_(0.3).requires_grad_() for s in range(7)]
    for config in CONFIGS:
        self_supervised_loss(flows, *images, config)[0].backward()
    assert all(torch.isfinite(flow.grad).all() for flow in flows)


def test_the_endpoint_loss_is_the_distance_and_ignores_what_is_unknown() -> None:
    truth = torch.zeros(1, 2, 4, 5, dtype=torch.float64)
    flow = truth + torch.tensor([3.0, 4.0]).view(1, 2, 1, 1)
    # sqrt(25 + e^2) - e is 5 - e + e^2 / 10
    assert endpoint_loss(flow, truth).item() == pytest.approx(5 - SOFTNESS_PX, abs=2e-5)
    assert endpoint_loss(truth, truth) == 0
    truth[:, 0, 2:] = torch.nan
    flow[:, :, 2:] = 1000
    flow.requires_grad_()
    loss = endpoint_loss(flow, truth)
    loss.backward()
    assert loss.item() == pytest.approx(5 - SOFTNESS_PX, abs=2e-5)
    assert torch.isfinite(flow.grad).all()
    assert not flow.grad[:, :, 2:].any()
    assert endpoint_loss(flow, torch.full_like(truth, torch.nan)) == 0


def test_the_flow_loss_is_zero_for_the_truth_at_all_scales_and_grows_with_the_error() -> None:
    truth = press_flow(64, 80, 5.0)[None]
    truth[..., :6] = torch.nan
    filled = [torch.nan_to_num(field) for field in flow_pyramid(truth, 7)]
    config = LossConfig()
    assert flow_loss(filled, truth, config)[0] == 0
    assert flow_loss([0.9 * field for field in filled], truth, config)[0] > 0


def test_the_flow_loss_has_the_gradient_of_finite_differences() -> None:
    random = torch.Generator().manual_seed(3)
    flows = [
        (0.1 + 0.8 * torch.rand(1, 2, 8 >> s, 8 >> s, generator=random, dtype=torch.float64)).requires_grad_()
        for s in range(3)
    ]
    truth = torch.randn(1, 2, 8, 8, generator=random, dtype=torch.float64)
    truth[..., 3] = torch.nan
    assert gradcheck(lambda *f: flow_loss(list(f), truth, LossConfig(lambda_s=(1.0, 0.5, 2.0)))[0], flows)
