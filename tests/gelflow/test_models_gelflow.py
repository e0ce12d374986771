"""The network: sizes of its answers, gradients, options, refusal of images that it cannot take."""

import pytest
import torch

from gelflow.config import ModelConfig
from gelflow.errors import InputError
from gelflow.models import GelFlow
from gelflow.models.estimate import estimate_flow
from gelflow.models.gelflow import normalised
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
