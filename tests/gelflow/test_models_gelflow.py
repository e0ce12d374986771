"""The network and its parts: sizes of its answers, local fusion, refinement, gradients, refusal of wrong images."""

import itertools
from functools import partial

import pytest
import torch
from commands import refused
from torch.autograd import gradcheck

from gelflow.config import ModelConfig
from gelflow.models import GelFlow
from gelflow.models.estimate import estimate_flow
from gelflow.models.gelflow import normalised
from gelflow.models.layers import ContextNetwork, LocalFlowFusion


@pytest.fixture(scope="module")
def network() -> GelFlow:
    torch.manual_seed(0)
    return GelFlow(ModelConfig())


@pytest.mark.parametrize("size", [(64, 64), (72, 80), (65, 127), (70, 131)])
def test_flows_of_all_scales_for_sizes_of_any_parity(network: GelFlow, size: tuple[int, int]) -> None:
    with torch.no_grad():
        flows = network(torch.rand(1, 3, *size), torch.rand(1, 3, *size))
    assert [tuple(flow.shape) for flow in flows] == [(1, 2, -(-size[0] // 2**s), -(-size[1] // 2**s)) for s in range(7)]
    assert all(flow.dtype == torch.float32 and torch.isfinite(flow).all() for flow in flows)
    # each of 6 scales adds two corrections of about 0.01 px, doubled at every finer one: 0.02 * 2^8 = 5 px at most
    assert 0 < flows[0].abs().max() < 5
    if size == (72, 80):  # the two finest flows are enlargements
        for scale, factor in ((1, 2), (0, 4)):
            expected = factor * torch.nn.functional.interpolate(flows[2], scale_factor=factor, mode="bilinear")
            assert torch.equal(flows[scale], expected)


@pytest.mark.parametrize("options", [{}, {"estimator": "shared"}, {"lffm": False}, {"levels": 4, "refine": "half"}])
def test_gradients_reach_every_parameter(options: dict) -> None:
    torch.manual_seed(0)
    network = GelFlow(ModelConfig(**options))
    flows = network(torch.rand(1, 3, 64, 72), torch.rand(1, 3, 64, 72))
    assert len(flows) == network.config.levels - 1
    sum(flow.square().mean() for flow in flows).backward()
    gradients = {name: value.grad for name, value in network.named_parameters()}
    assert [name for name, gradient in gradients.items() if gradient is None or not gradient.any()] == []
    assert all(torch.isfinite(gradient).all() for gradient in gradients.values())


def test_features_are_normalised_one_network_is_smaller_and_batches_do_not_matter(network: GelFlow) -> None:
    first, second = 3 + 2 * torch.randn(2, 2, 8, 6, 5, dtype=torch.float64)
    both = torch.stack(normalised(first, second))
    for sample in range(2):
        # the 1e-6 beside a variance of 4 lowers the result by a quarter of it
        assert abs(both[:, sample].mean().item()) < 1e-12
        assert abs(both[:, sample].var(unbiased=False).item() - 1) < 1e-6
    shared, per_scale = (GelFlow(ModelConfig(estimator=kind)).parameters() for kind in ("shared", "per_scale"))
    assert sum(p.numel() for p in shared) < 0.4 * sum(p.numel() for p in per_scale)
    image1, image2 = torch.rand(2, 3, 3, 64, 96)
    with torch.no_grad():
        together, alone = network(image1, image2)[0], network(image1[1:2], image2[1:2])[0]
    # float32 convolutions of other shapes: relative 1e-5 of flows of about 0.1 px
    torch.testing.assert_close(together[1:2], alone, rtol=1e-4, atol=1e-5)


def test_wrong_images_are_refused(network: GelFlow) -> None:
    good = torch.rand(1, 3, 64, 64)
    for first, second, words in (
        (good, torch.rand(1, 3, 64, 80), "differ in shape: 64x64 and 64x80"), (good[:, :1], good[:, :1], "3 colours"),
        (torch.rand(1, 3, 15, 200), torch.rand(1, 3, 15, 200), "at least"), (good[0], good[0], "3 colours"),
    ):  # fmt: skip
        for call in (network, partial(estimate_flow, network)):
            refused(words, call, first, second)
    refused("at least 64 px", network, *torch.rand(2, 1, 3, 63, 200))
    broken = good.clone()
    broken[0, 1, 5, 5] = torch.nan
    refused("image 2 holds NaN", estimate_flow, network, good, broken)


class FixedFlow(GelFlow):
    """A network that sees a motion of (2, 3) px of the images that it is given, whatever they are."""

    def forward(self, image1: torch.Tensor, image2: torch.Tensor) -> list[torch.Tensor]:
        self.seen = tuple(image1.shape[-2:])
        return [torch.tensor([2.0, 3.0]).view(1, 2, 1, 1).expand(len(image1), 2, *self.seen)]


def test_estimate_scales_each_component_with_its_side_and_works_at_the_size_of_training_unless_told_otherwise() -> None:
    network = FixedFlow(ModelConfig(levels=4)).train()
    images = torch.rand(2, 2, 3, 120, 320).unbind()
    flow = estimate_flow(network, *images, size=(240, 64))
    assert (network.seen, network.training, flow.requires_grad) == ((240, 64), True, False)
    expected = torch.tensor([2.0 * 320 / 64, 3.0 * 120 / 240]).view(1, 2, 1, 1)
    torch.testing.assert_close(flow, expected.expand(2, 2, 120, 320))
    for size, seen in ((None, (120, 320)), ((64, 72), (64, 72))):
        network.image_size = size
        estimate_flow(network, *images)
        assert network.seen == seen
    small = torch.rand(2, 1, 3, 20, 30).unbind()
    assert estimate_flow(network, *small, size=(64, 96)).shape == (1, 2, 20, 30)
    refused("size 10x64", estimate_flow, network, *images, size=(10, 64))


def test_the_context_network_sees_33_pixels_far() -> None:
    """PWC-Net's dilations 1, 2, 4, 8, 16, 1 and the head's 3x3: a pixel farther for each of each layer's."""
    torch.manual_seed(0)
    network, seen = ContextNetwork().double(), torch.randn(1, 34, 1, 75, dtype=torch.float64, requires_grad=True)
    network(seen[:, :32], seen[:, 32:])[..., 37].sum().backward()
    places = seen.grad.abs().sum(dim=(0, 1, 2)).nonzero()
    assert (places.min(), places.max(), len(places)) == (37 - 33, 37 + 33, 67)


@pytest.mark.parametrize(("scale", "factor"), [("inverse_sqrt", 8**-0.5), ("none", 1.0)])
def test_weights_are_a_softmax_over_the_neighbours_inside(scale: str, factor: float) -> None:
    context = torch.randn(2, 8, 6, 7, dtype=torch.float64)
    weights = GelFlow(ModelConfig(levels=4, lffm_scale=scale)).fusion.weights(context)
    # a softmax of at most 9 terms in double precision
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(2, 6, 7, dtype=torch.float64), rtol=0, atol=1e-14)
    row, column = 0, 5
    logits = torch.full((9,), -torch.inf, dtype=torch.float64)
    for place, (dy, dx) in enumerate(itertools.product((-1, 0, 1), repeat=2)):
        if 0 <= row + dy < 6 and 0 <= column + dx < 7:
            logits[place] = factor * context[0, :, row, column] @ context[0, :, row + dy, column + dx]
    torch.testing.assert_close(weights[0, :, row, column], logits.softmax(dim=0), rtol=0, atol=1e-14)


def test_a_fused_flow_lies_between_its_neighbours_and_a_constant_one_stays() -> None:
    fuse, context = LocalFlowFusion("inverse_sqrt"), torch.randn(1, 32, 9, 8, dtype=torch.float64)
    constant = torch.tensor([3.0, -1.5], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, 9, 8)
    # weights sum to one within 1e-14, times 3 px
    torch.testing.assert_close(fuse(constant, context), constant, rtol=0, atol=1e-13)
    flow = torch.randn(1, 2, 9, 8, dtype=torch.float64)
    fused = fuse(flow, context)
    upper, lower = (sign * torch.nn.functional.max_pool2d(sign * flow, 3, 1, 1) for sign in (1, -1))
    assert (fused <= upper + 1e-12).all()  # sums of numbers of size 1
    assert (fused >= lower - 1e-12).all()
    assert (fused - flow).abs().max() > 0.1


def test_fusion_has_the_gradients_of_differences_and_refinement_corrects_two_scales() -> None:
    flow, context = torch.randn(1, 2, 3, 4, dtype=torch.float64), torch.randn(1, 3, 3, 4, dtype=torch.float64)
    assert gradcheck(LocalFlowFusion("inverse_sqrt"), (flow.requires_grad_(), context.requires_grad_()))
    torch.manual_seed(0)
    network = GelFlow(ModelConfig(levels=4, refine="half"))
    images = torch.rand(2, 1, 3, 66, 71).unbind()
    with torch.no_grad():
        before = [flow.clone() for flow in network(*images)]
        network.refinement.head.bias += torch.tensor([0.5, 0.0])
        after = network(*images)
    assert [tuple(flow.shape[2:]) for flow in after] == [(66, 71), (33, 36), (17, 18)]
    assert torch.equal(after[2], before[2])
    assert (after[1] != before[1]).any()
    # Three corrections of about 0.5 px at the head's scale, doubled where it is enlarged.
    assert (after[0] - before[0])[:, 0].mean() == pytest.approx(3.0, rel=0.1)
