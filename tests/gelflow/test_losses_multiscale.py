"""The sum over scales, the endpoint loss, and what ARFlow's configuration adds to them."""

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck
from waves import moved_pair, pixel_centres, press_flow

from gelflow.config import LossConfig
from gelflow.losses import flow_loss, self_supervised_loss
from gelflow.losses.augmentation_consistency import consistency_loss, transformed_pair
from gelflow.losses.endpoint import SOFTNESS_PX, endpoint_loss
from gelflow.losses.occlusion import visible_in_both_images
from gelflow.losses.smoothness import second_order_loss
from gelflow.ops.pyramid import flow_pyramid
from gelflow.ops.warp import inside, warp

CONFIGS = [
    LossConfig(),
    LossConfig(smoothness="first_order"),
    LossConfig(ratio="det", weight="edge_aware"),
    LossConfig(weight="floor"),
    LossConfig(lambda_dc=0, lambda_df=0),
]


def random(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def pressed() -> tuple[Tensor, Tensor, Tensor]:
    """True flow, up to 8 px, and both images, 240 x 320 px."""
    flow = press_flow(240, 320, 8.0)
    image1, image2 = moved_pair(flow, seed=5)
    return flow[None], image1[None], image2[None]


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: f"{config.smoothness}-{config.weight}")
def test_the_true_flow_scores_better_than_none_and_than_a_tenth_more_or_less(config, pressed) -> None:
    """The latter at the scales that resolve the texture (s = 0, 1, 2). At coarser ones, the published loss itself
    prefers too little motion: the pattern is averaged away, and the regulariser is what is left.
    """
    flow, image1, image2 = pressed
    flows, fine = flow_pyramid(flow, 7), config.model_copy(update={"lambda_s": (1.0, 1.0, 1.0)})

    def loss(factor: float, flows: list[Tensor], config: LossConfig) -> Tensor:
        return self_supervised_loss([factor * field for field in flows], image1, image2, config)[0]

    assert loss(1, flows, config) < 0.75 * loss(0, flows, config)
    less, true, more = (loss(factor, flows[:3], fine) for factor in (0.9, 1, 1.1))
    assert true < min(less, more)


def test_without_normalisation_no_flow_scores_better_than_the_true_one(pressed: tuple[Tensor, Tensor, Tensor]) -> None:
    """The trap that `flow_normalisation` avoids: lambda_dc = 75 acting on px."""
    flow, *images = pressed
    config = LossConfig(flow_normalisation="none")
    true, still = (self_supervised_loss(flow_pyramid(f * flow, 7), *images, config)[0] for f in (1, 0))
    assert true > still


def test_parts_add_up_scales_are_weighted_and_a_mask_removes_pixels() -> None:
    flows = flow_pyramid(torch.randn(1, 2, 64, 64, dtype=torch.float64), 3)
    images = torch.rand(2, 1, 3, 64, 64, dtype=torch.float64)

    def total(*weights: float, smoothness: str = "helmholtz") -> Tensor:
        loss, parts = self_supervised_loss(flows, *images, LossConfig(lambda_s=weights, smoothness=smoothness))
        assert bool(parts["deformation"]) == (smoothness == "helmholtz")  # SelfFlow has none
        # a sum of three numbers of size one
        assert abs(sum(parts.values()) - loss) < 1e-14
        return loss

    separate = 2 * total(1, 0, 0) + total(0, 1, 0) + 0.5 * total(0, 0, 1)
    assert abs(total(2, 1, 0.5) - separate) < 1e-13
    total(1, 1, 1, smoothness="first_order")
    images = torch.rand(2, 1, 3, 64, 64, generator=random(3)).unbind()
    flows = flow_pyramid(torch.zeros(1, 2, 64, 64), 3)
    config = LossConfig(lambda_s=(1, 1, 1), lambda_dc=0, lambda_df=0, alpha=0)
    broken = images[0].clone()
    broken[..., 32:, :] = images[1][..., 32:, :]
    mask = torch.ones(1, 1, 64, 64)
    mask[..., :32, :] = 0
    assert self_supervised_loss(flows, broken, images[1], config)[0] > 0.1
    assert self_supervised_loss(flows, broken, images[1], config, mask)[0] == 0


def test_losses_of_known_flow_grow_with_the_error_and_ignore_what_is_unknown() -> None:
    truth = torch.zeros(1, 2, 4, 5, dtype=torch.float64)
    flow = truth + torch.tensor([3.0, 4.0]).view(1, 2, 1, 1)
    # sqrt(25 + e^2) - e is 5 - e + e^2 / 10
    expected = pytest.approx(5 - SOFTNESS_PX, abs=2e-5)
    assert endpoint_loss(flow, truth).item() == expected
    assert endpoint_loss(truth, truth) == 0
    truth[:, 0, 2:], flow[:, :, 2:] = torch.nan, 1000
    flow.requires_grad_()
    loss = endpoint_loss(flow, truth)
    loss.backward()
    assert loss.item() == expected
    assert torch.isfinite(flow.grad).all()
    assert not flow.grad[:, :, 2:].any()
    assert endpoint_loss(flow, torch.full_like(truth, torch.nan)) == 0
    truth = press_flow(64, 80, 5.0)[None]
    truth[..., :6] = torch.nan
    filled = [torch.nan_to_num(field) for field in flow_pyramid(truth, 7)]
    assert flow_loss(filled, truth, LossConfig())[0] == 0
    assert flow_loss([0.9 * field for field in filled], truth, LossConfig())[0] > 0


def test_losses_have_the_gradients_of_finite_differences_at_every_scale() -> None:
    generator = random(3)

    def noise(*size: int) -> Tensor:
        return torch.rand(1, 2, *size, generator=generator, dtype=torch.float64)

    flows = [(0.1 + 0.8 * noise(8 >> s, 8 >> s)).requires_grad_() for s in range(3)]
    truth = 3 * noise(8, 8) - 1.5
    truth[..., 3] = torch.nan
    assert gradcheck(lambda *f: flow_loss(list(f), truth, LossConfig(lambda_s=(1.0, 0.5, 2.0)))[0], flows)
    target = noise(5, 6)
    flow = (target + 0.2 + noise(5, 6)).requires_grad_()
    pixels = (noise(5, 6)[:, :1] > 0.3).double()
    assert gradcheck(lambda f: consistency_loss(f, target, pixels), (flow,))
    images = torch.rand(2, 1, 3, 64, 64)
    flows = [torch.randn(1, 2, 64 >> s, 64 >> s).mul_(0.3).requires_grad_() for s in range(7)]
    for config in CONFIGS:
        self_supervised_loss(flows, *images, config)[0].backward()
    assert all(torch.isfinite(flow.grad).all() for flow in flows)


def test_second_order_is_zero_for_affine_flows_and_known_for_a_parabola() -> None:
    x, y = pixel_centres(10, 12)
    image = torch.zeros(1, 3, 10, 12, dtype=torch.float64)
    affine = torch.stack([0.3 * x - 0.2 * y + 1, 0.1 * x + 0.4 * y])[None]
    assert second_order_loss(affine, image) < 1e-13  # differences of numbers up to 5
    bent = torch.stack([0.05 * x**2, 0.1 * y**2])[None]
    # u_xx = 0.1, v_yy = 0.2, each counted once, halved
    assert second_order_loss(bent, image).item() == pytest.approx(0.15, abs=1e-12)
    assert second_order_loss(bent[..., :2, :], image[..., :2, :]) == 0


def test_occlusion_keeps_what_closes_and_hides_nothing_where_nothing_does() -> None:
    x, y = pixel_centres(40, 60)
    # A stretch about the middle: forward x' = 1.4 x, backward exactly its inverse, so that x + forward closes.
    forward = torch.stack([0.4 * (x - 30), 0.4 * (y - 20)])[None]
    backward = torch.stack([(1 / 1.4 - 1) * (x - 30), (1 / 1.4 - 1) * (y - 20)])[None]
    seen = visible_in_both_images(forward, backward)
    stays = ((1.4 * (x - 30)).abs() <= 29.5) & ((1.4 * (y - 20)).abs() <= 19.5)
    assert torch.equal(seen[0, 0] > 0, stays)
    backward[..., 20:30] += 1.5  # a strip that goes elsewhere: 1.5^2 > 0.5 + 1 % of the motion
    hidden = (1.4 * (x - 30) + 30 > 21.5) & (1.4 * (x - 30) + 30 < 28.5) & stays
    assert not visible_in_both_images(forward, backward)[0, 0][hidden].any()
    # Else a loss over no pixel would leave a new network where it is. The second pair closes on a fifth.
    forward, backward = torch.full((2, 2, 10, 20), 1.5), torch.full((2, 2, 10, 20), 1.5)
    backward[1, :, :4] = -1.5
    seen = visible_in_both_images(forward, backward)
    stays = inside(forward)
    assert torch.equal(seen[0], stays[0])
    assert 0 < seen[1].mean() < 0.3


def test_the_transformed_pair_moves_as_its_flow_says_and_follows_the_generator() -> None:
    flow = press_flow(120, 160, 3.0)[None]
    image1, image2 = (image[None] for image in moved_pair(flow[0], seed=8, shortest=24, longest=60))
    for seed in (1, 2, 3):
        first, second, turned, pixels = transformed_pair(image1, image2, flow, random(seed))
        mask = -torch.nn.functional.max_pool2d(-pixels, 9, stride=1, padding=4)

        def error(field: Tensor, mask: Tensor = mask, first: Tensor = first, second: Tensor = second) -> float:
            return (((warp(second, field) - first).abs()) * mask).sum().item() / mask.sum().item()

        # Both images carry noise of 0.02: a mean difference of 0.02 * sqrt(2) * sqrt(2/pi) = 0.0226 per colour, three
        # of them; interpolation adds less than a tenth.
        assert error(turned) < 1.1 * 3 * 0.0226
        assert error(turned) < min(error(0.8 * turned), error(1.2 * turned), error(flow.to(turned)))
        assert consistency_loss(turned, turned, pixels) == pytest.approx(0.01**0.4)
    flow, images = torch.rand(1, 2, 64, 64), torch.rand(2, 1, 3, 64, 64).unbind()
    one, again, other = (transformed_pair(*images, flow, random(seed))[0] for seed in (4, 4, 5))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
