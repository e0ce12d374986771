"""The network and its parts: sizes of its answers, local fusion, refinement, gradients, refusal of wrong images."""

import pytest
import torch
from torch.autograd import gradcheck

from gelflow.config import ModelConfig
from gelflow.errors import InputError
from gelflow.models import GelFlow
from gelflow.models.estimate import estimate_flow
from gelflow.models.gelflow import normalised
from gelflow.models.lffm import LocalFlowFusion
from gelflow.ops.resize import resize_flow


@pytest.fixture(scope="module")
def network() -> GelFlow:
    torch.manual_seed(0)
    return GelFlow(ModelConfig())


@pytest.mark.parametrize("size", [(64, 64), (240, 320), (65, 127), (70, 131)])
def test_flows_of_all_scales_for_sizes_of_any_parity(network: GelFlow, size: tuple[int, int]) -> None:
    with torch.no_grad():
        flows = network(torch.rand(1, 3, *size), torch.rand(1, 3, *size))
    assert [tuple(flow.shape) for flow in flows] == [(1, 2, -(-size[0] // 2**s), -(-size[1] // 2**s)) for s in range(7)]
    assert all(flow.dtype == torch.float32 and torch.isfinite(flow).all() for flow in flows)


def test_the_two_finest_flows_are_enlargements(network: GelFlow) -> None:
    with torch.no_grad():
        flows = network(torch.rand(1, 3, 72, 80), torch.rand(1, 3, 72, 80))
    for scale, factor in ((1, 2), (0, 4)):
        expected = factor * torch.nn.functional.interpolate(flows[2], scale_factor=factor, mode="bilinear")
        assert torch.equal(flows[scale], expected)


def test_a_fresh_network_predicts_little_motion(network: GelFlow) -> None:
    with torch.no_grad():
        flow = network(torch.rand(1, 3, 96, 96), torch.rand(1, 3, 96, 96))[0]
    # each of 6 scales adds two corrections of about 0.01 px, doubled at every finer one: 0.02 * 2^8 = 5 px at most
    assert 0 < flow.abs().max() < 5


@pytest.mark.parametrize(
    "options",
    [{}, {"estimator": "shared"}, {"lffm": False}, {"levels": 5, "finest_scale": 1}, {"normalise_features": False}],
)
def test_gradients_reach_every_parameter(options: dict) -> None:
    torch.manual_seed(0)
    network = GelFlow(ModelConfig(**options))
    flows = network(torch.rand(1, 3, 64, 72), torch.rand(1, 3, 64, 72))
    assert len(flows) == network.config.levels - 1
    sum(flow.square().mean() for flow in flows).backward()
    dead = [name for name, value in network.named_parameters() if value.grad is None or not value.grad.any()]
    assert dead == []


def test_one_network_for_all_scales_is_smaller() -> None:
    sizes = {kind: sum(p.numel() for p in GelFlow(ModelConfig(estimator=kind)).parameters())
             for kind in ("shared", "per_scale")}  # fmt: skip
    assert sizes["shared"] < 0.4 * sizes["per_scale"]


def test_normalised_features_have_mean_zero_and_variance_one_together() -> None:
    first, second = 3 + 2 * torch.randn(2, 2, 8, 6, 5, dtype=torch.float64)
    both = torch.stack(normalised(first, second))
    for sample in range(2):
        # the 1e-6 beside a variance of 4 lowers the result by a quarter of it
        assert abs(both[:, sample].mean().item()) < 1e-12
        assert abs(both[:, sample].var(unbiased=False).item() - 1) < 1e-6


def test_same_input_and_batch_position_do_not_matter(network: GelFlow) -> None:
    image1, image2 = torch.rand(2, 3, 3, 64, 96)
    with torch.no_grad():
        together, alone = network(image1, image2)[0], network(image1[1:2], image2[1:2])[0]
    # float32 convolutions of other shapes: relative 1e-5 of flows of about 0.1 px
    torch.testing.assert_close(together[1:2], alone, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ((1, 3, 64, 64), (1, 3, 64, 80), "differ in shape: 64x64 and 64x80"),
        ((1, 1, 64, 64), (1, 1, 64, 64), "3 colours"),
        ((1, 3, 63, 200), (1, 3, 63, 200), "at least 64 px"),
        ((3, 64, 64), (3, 64, 64), "3 colours"),
    ],
)
def test_wrong_images_are_refused(network: GelFlow, first: tuple, second: tuple, words: str) -> None:
    for call in (network, lambda a, b: estimate_flow(network, a, b)):
        with pytest.raises(InputError, match=words):
            call(torch.rand(first), torch.rand(second))


def test_estimate_refuses_values_that_are_not_finite(network: GelFlow) -> None:
    image = torch.rand(1, 3, 64, 64)
    broken = image.clone()
    broken[0, 1, 5, 5] = torch.nan
    with pytest.raises(InputError, match="image 2 holds NaN"):
        estimate_flow(network, image, broken)


class FixedFlow(GelFlow):
    """A network that sees a motion of (2, 3) px of the images that it is given, whatever they are."""

    def forward(self, image1: torch.Tensor, image2: torch.Tensor) -> list[torch.Tensor]:
        self.seen = tuple(image1.shape[-2:])
        return [torch.tensor([2.0, 3.0]).view(1, 2, 1, 1).expand(len(image1), 2, *self.seen)]


def test_estimate_scales_each_component_with_its_side() -> None:
    network = FixedFlow(ModelConfig(levels=4, finest_scale=2)).train()
    images = torch.rand(2, 2, 3, 120, 320).unbind()
    flow = estimate_flow(network, *images, size=(240, 64))
    assert network.seen == (240, 64)
    assert network.training
    assert not flow.requires_grad
    expected = torch.tensor([2.0 * 320 / 64, 3.0 * 120 / 240]).view(1, 2, 1, 1)
    torch.testing.assert_close(flow, expected.expand(2, 2, 120, 320))


def test_estimate_works_at_the_size_of_the_training_images_unless_told_otherwise() -> None:
    network = FixedFlow(ModelConfig(levels=4, finest_scale=2))
    images = torch.rand(2, 1, 3, 80, 90).unbind()
    estimate_flow(network, *images)
    assert network.seen == (80, 90)
    network.image_size = (64, 72)
    estimate_flow(network, *images)
    assert network.seen == (64, 72)
    small = torch.rand(2, 1, 3, 20, 30).unbind()
    assert estimate_flow(network, *small, size=(64, 96)).shape == (1, 2, 20, 30)
    with pytest.raises(InputError, match="size 10x64"):
        estimate_flow(network, *images, size=(10, 64))


def test_resizing_a_flow_there_and_back_keeps_an_affine_one() -> None:
    columns = (torch.arange(16, dtype=torch.float64) + 0.5).expand(12, 16)
    flow = torch.stack([0.1 * columns, 2 - 0.05 * columns])[None]
    back = resize_flow(resize_flow(flow, (24, 48)), (12, 16))
    # exact but near the border, where enlarging repeats it; sums of numbers of size 2
    torch.testing.assert_close(back[..., 1:-1], flow[..., 1:-1], rtol=0, atol=1e-13)


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


def test_it_corrects_its_scale_and_the_finer_one() -> None:
    torch.manual_seed(0)
    network = GelFlow(ModelConfig(levels=4, refine="half", refine_iterations=2))
    images = torch.rand(2, 1, 3, 66, 71).unbind()
    flows = network(*images)
    assert [tuple(flow.shape[2:]) for flow in flows] == [(66, 71), (33, 36), (17, 18)]
    before = [flow.detach().clone() for flow in flows]
    with torch.no_grad():
        network.refinement.head.bias += torch.tensor([0.5, 0.0])
        after = network(*images)
    assert torch.equal(after[2], before[2])
    assert (after[1] != before[1]).any()
    # Two corrections of about 0.5 px at the head's scale, doubled where it is enlarged.
    change = (after[0] - before[0])[:, 0].mean()
    assert change == pytest.approx(2.0, rel=0.1)


def test_its_weights_have_a_gradient() -> None:
    network = GelFlow(ModelConfig(levels=4, refine="half", refine_iterations=1))
    sum(flow.square().mean() for flow in network(*torch.rand(2, 1, 3, 64, 64).unbind())).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.refinement.parameters())
    assert network.refinement.layers[0][0].weight.grad.any()


def test_half_resolution_that_is_decoded_already_is_refused() -> None:
    with pytest.raises(ValueError, match="adds nothing to finest_scale = 1"):
        ModelConfig(finest_scale=1, refine="half")
