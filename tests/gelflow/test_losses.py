"""The losses: each term and their sum over scales, in closed forms, and gradients against finite differences."""

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck
from waves import moved_pair, pixel_centres, press_flow

from gelflow.config import LossConfig, TrainConfig
from gelflow.losses import flow_loss, self_supervised_loss
from gelflow.losses.augmentation_consistency import consistency_loss, transformed_pair
from gelflow.losses.multiscale import SOFTNESS_PX, endpoint_loss
from gelflow.losses.photometric import (
    C1,
    C2,
    appearance_loss,
    photometric_loss,
    structural_similarity,
    visible_in_both_images,
)
from gelflow.losses.regularisers import (
    area_ratio,
    decomposition_loss,
    deformation_loss,
    edge_aware_loss,
    regulariser_weight,
)
from gelflow.ops.pyramid import flow_pyramid
from gelflow.ops.warp import inside, warp
from gelflow.training.module import validation_metrics

ONES = torch.ones(1, 1, 9, 11, dtype=torch.float64)


def test_structural_similarity_follows_its_definition_and_equal_images_cost_nothing() -> None:
    first, second = torch.rand(2, 1, 1, 5, 6, dtype=torch.float64)
    for row, column in ((2, 3), (0, 0)):
        rows, columns = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
        a, b = first[0, 0, rows, columns].flatten(), second[0, 0, rows, columns].flatten()
        covariance = ((a - a.mean()) * (b - b.mean())).mean()
        expected = (2 * a.mean() * b.mean() + C1) * (2 * covariance + C2)
        expected = expected / (a.mean() ** 2 + b.mean() ** 2 + C1) / (a.var(correction=0) + b.var(correction=0) + C2)
        # differences of squares of size 1 over at least C2 = 9e-4, in double precision
        assert abs(structural_similarity(first, second)[0, 0, row, column] - expected) < 1e-11
    image = torch.rand(1, 3, 12, 15, dtype=torch.float64)
    loss = photometric_loss(image, image, torch.zeros(1, 2, 12, 15, dtype=torch.float64), 0.85)
    assert 0 <= loss + 1e-11 < 2e-11  # warping errs by 1e-14; SSIM is 1 up to 1e-14 / C2
    image1, image2 = torch.rand(2, 1, 3, 1, 1, dtype=torch.float64)
    loss = photometric_loss(image1, image2, torch.zeros(1, 2, 1, 1, dtype=torch.float64), alpha=0)
    assert abs(loss - (image1 - image2).abs().mean()) < 1e-15
    flow = torch.zeros(2, 64, 64, dtype=torch.float64)
    flow[0] = 10
    image1, image2 = (image[None] for image in moved_pair(flow, seed=4))
    # An integer shift: exact but for rounding, as above.
    assert photometric_loss(image1, image2, flow[None], 0.85) < 1e-9
    assert appearance_loss(image1, warp(image2, flow[None]), torch.ones(1, 1, 64, 64), 0.85) > 0.01
    assert photometric_loss(image1, image2, flow[None] * 100, 0.85) == 0  # nothing left to compare
    pair = {"image1": image1.float(), "image2": image2.float()}
    found = validation_metrics(pair, flow[None].float() * 100, TrainConfig())
    assert {name: bool(value.isnan()) for name, value in found.items()} == {
        "psnr_db": True, "no_motion_psnr_db": False, "photometric_loss": True,
    }  # fmt: skip


def affine_flow(matrix: list[list[float]]) -> Tensor:
    """(1, 2, 10, 12) float64: V = matrix (x, y) + (1.5, -0.7)."""
    x, y = pixel_centres(10, 12)
    return torch.stack([m[0] * x + m[1] * y + s for m, s in zip(matrix, (1.5, -0.7), strict=True)])[None]


@pytest.mark.parametrize(("matrix", "parts"), [
    ([[0, 0], [0, 0]], (0, 0, 0)),  # translation
    ([[0.2, 0], [0, -0.1]], (0.3, 0, 0)),  # stretch: |e_xx| + |e_yy|
    ([[0, 0.1], [0.1, 0]], (0, 0.2, 0)),  # pure shear: 2 |e_xy|
    ([[0, -0.1], [0.1, 0]], (0, 0, 0.2)),  # rotation: 2 |omega|
    ([[0.1, 0.3], [-0.05, 0.2]], (0.3, 0.25, 0.35)),
])  # fmt: skip
def test_decomposition_separates_stretch_shear_and_rotation_and_affine_flows_cost_no_deformation(matrix, parts) -> None:
    flow = affine_flow(matrix)
    loss = decomposition_loss(flow, ONES, lambda_theta=10, lambda_zeta=100)
    # 100 times differences of numbers up to 5, in double precision
    assert loss.item() == pytest.approx(parts[0] + 10 * parts[1] + 100 * parts[2], abs=1e-11)
    assert (edge_aware_loss(flow, torch.rand(1, 3, 10, 12, dtype=torch.float64), 10.0, 1) == 0) == (not any(parts))
    assert deformation_loss(flow, ONES) < 1e-13  # rounding: numbers up to 5 give slopes good to 1e-15


def test_area_ratios_of_a_stretch_and_of_a_rotation_and_the_cost_of_a_growing_stretch() -> None:
    c, s = math.cos(0.1) - 1, math.sin(0.1)
    stretch, turn = affine_flow([[0.25, 0], [0, -0.2]]), affine_flow([[c, -s], [s, c]])
    for flow, expected in ((stretch, 1.25 * 0.8), (turn, (c + 1) ** 2)):
        assert area_ratio(flow).sub(expected).abs().max() < 1e-13
    x, _ = pixel_centres(10, 12)
    flow = torch.stack([0.05 * x**2, torch.zeros_like(x)])[None]  # R = 1 + 0.1 x: gradient 0.1 along x
    assert deformation_loss(flow, ONES).item() == pytest.approx(0.1, abs=1e-12)


def test_the_deformation_loss_is_of_the_flow_in_px_and_smoothness_of_shares_of_the_shorter_side() -> None:
    x, _ = pixel_centres(10, 12)
    flow, image = torch.stack([0.05 * x**2, torch.zeros_like(x)])[None], torch.zeros(1, 3, 10, 12, dtype=torch.float64)
    config = LossConfig(lambda_s=(1.0,), lambda_dc=2.0, lambda_df=3.0, least_weight=1.0)
    _, parts = self_supervised_loss([flow], image, image, config)
    # R = 1 + 0.1 x; forward differences 0.1 (x + 0.5) of 1 to 11, with a mean of 0.6 px a pixel, on a side of 10 px.
    assert parts["deformation"].item() == pytest.approx(3 * 0.1, rel=1e-12)
    assert parts["smoothness"].item() == pytest.approx(2 * 0.6 / 10, rel=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 9)])
def test_scales_too_small_for_a_derivative_cost_nothing_and_keep_the_gradient_defined(size: tuple[int, int]) -> None:
    flow = torch.randn(1, 2, *size, requires_grad=True)
    weight, image = torch.ones(1, 1, size[0] - 1, size[1] - 1), torch.rand(1, 3, *size)
    loss = deformation_loss(flow, weight)
    if size[0] == 1:
        loss = loss + decomposition_loss(flow, weight, 0.01, 0.01) + edge_aware_loss(flow, image, 10.0, 1)
    loss.backward()
    assert loss == 0
    assert not flow.grad.any()


def test_edge_aware_smoothness_is_that_of_arflow_computed_by_hand() -> None:
    step = math.log(2) / 10  # at beta = 10, of weight 1/2
    down = torch.tensor([0.0, step], dtype=torch.float64).view(1, 1, 2, 1).expand(1, 3, 2, 3)
    u, v = [[0, 1, 3], [0, 1, 3]], [[0, 0, 0], [4, 4, 8]]
    flow = torch.tensor([[u, v]], dtype=torch.float64)
    # Along x 1 + 2 + 1 + 2 of u and 4 of v over 8 numbers, along y half of 4 + 4 + 8 of v over 6; both over 4.
    assert edge_aware_loss(flow, down, 10.0, 1).item() == pytest.approx((10 / 8 + 8 / 6) / 4, rel=1e-14)
    assert edge_aware_loss(flow[..., :1], down[..., :1], 10.0, 1) == 0
    across = torch.tensor([0.0, 0.0, step, step], dtype=torch.float64).view(1, 1, 1, 4).expand(1, 3, 3, 4)
    u, v = [[0, 1, 3, 7]] * 3, [[0] * 4, [2] * 4, [8] * 4]
    flow = torch.tensor([[u, v]], dtype=torch.float64)
    # Of three rows half of u_xx = 1 and all of 2 over 12 numbers, of four columns v_yy = 4 over 8; both over 2.
    assert edge_aware_loss(flow, across, 10.0, 2).item() == pytest.approx((3 * 2.5 / 12 + 4 * 4 / 8) / 2, rel=1e-14)
    assert edge_aware_loss(flow[..., :2, :], across[..., :2, :], 10.0, 2) == 0


def test_the_anti_edge_weight_follows_its_definition_at_edges() -> None:
    image = torch.zeros(1, 3, 3, 4, dtype=torch.float64)
    image[0, :, :, 2:] = torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64).view(3, 1, 1)  # |grad I| = 0.2 in the mean
    edge = math.exp(-10 * 0.2)
    for least in (0.0, 0.1):
        weight = regulariser_weight(image, 10.0, least)
        assert weight.shape == (1, 1, 2, 3)
        expected = torch.tensor([least, 1 - edge, least], dtype=torch.float64).expand(1, 1, 2, 3)
        torch.testing.assert_close(weight, expected, rtol=0, atol=1e-14)


ALONE = {"alpha": 0.5, "lambda_dc": 0.0, "lambda_df": 0.0}
REGULARISER = {"alpha": 0.0, "lambda_dc": 3.0, "lambda_df": 0.0}
TERMS = {
    "absolute difference": {**ALONE, "alpha": 0.0},
    "structural similarity": {**ALONE, "alpha": 1.0},
    "spline": {**ALONE, "warping": "spline"},
    "on the images": {**ALONE, "compare_at": "image"},
    "decomposition": REGULARISER,
    "least weight": {**REGULARISER, "least_weight": 0.9},
    "deformation": {**REGULARISER, "lambda_dc": 0.0, "lambda_df": 3.0},
    "first order": {**REGULARISER, "smoothness": "first_order"},
    "second order": {**REGULARISER, "smoothness": "second_order"},
    "second order, its own weights": {**REGULARISER, "smoothness": "second_order", "smoothness_s": (0.0, 2.0)},
}


@pytest.mark.parametrize("masked", [False, True], ids=["all pixels", "some hidden"])
@pytest.mark.parametrize("term", list(TERMS))
def test_the_gradient_is_that_of_finite_differences(term: str, masked: bool) -> None:
    generator = random(5)

    def noise(*size: int) -> Tensor:
        return 0.2 * torch.rand(*size, generator=generator, dtype=torch.float64)

    # Of little contrast, so that weights exp(-10 |grad I|) do not vanish.
    images = (0.4 + noise(2, 1, 3, 9, 10)).unbind()
    # Away from the kinks of interpolation, at whole numbers of px at both scales, and from the image's border.
    flows = [(0.15 + noise(1, 2, *size)).requires_grad_() for size in ((9, 10), (5, 5))]
    visible = torch.ones(1, 1, 9, 10, dtype=torch.float64)
    visible[..., :2], visible[..., 8, :] = 0.0, 0.0
    config = LossConfig(lambda_s=(1.0, 0.5), **TERMS[term])

    def loss(*fields: Tensor) -> Tensor:
        return self_supervised_loss(list(fields), *images, config, visible if masked else None)[0]

    assert gradcheck(loss, flows)
    finest, _ = torch.autograd.grad(loss(*flows), flows)
    assert finest.abs().max() > 1e-4  # not the agreement of two zeros


def random(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_parts_add_up_scales_are_weighted_and_a_mask_removes_pixels() -> None:
    flows = flow_pyramid(torch.randn(1, 2, 64, 64, dtype=torch.float64), 3)
    images = torch.rand(2, 1, 3, 64, 64, dtype=torch.float64)

    def total(*weights: float, smoothness: str = "helmholtz") -> Tensor:
        loss, parts = self_supervised_loss(flows, *images, LossConfig(lambda_s=weights, smoothness=smoothness))
        assert bool(parts["deformation"]) == (smoothness == "helmholtz")  # SelfFlow has none
        assert abs(sum(parts.values()) - loss) < 1e-14  # a sum of three numbers of size one
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
    expected = pytest.approx(5 - SOFTNESS_PX, abs=2e-5)  # sqrt(25 + e^2) - e is 5 - e + e^2 / 10
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


def test_supervised_and_consistency_losses_have_the_gradients_of_finite_differences() -> None:
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


def test_second_order_smoothness_of_affine_flows_is_zero() -> None:
    x, y = pixel_centres(10, 12)
    affine = torch.stack([0.3 * x - 0.2 * y + 1, 0.1 * x + 0.4 * y])[None]
    assert edge_aware_loss(affine, torch.zeros(1, 3, 10, 12), 10.0, 2) < 1e-13  # differences of numbers up to 5


def test_occlusion_keeps_what_closes_and_hides_nothing_where_nothing_does() -> None:
    x, y = pixel_centres(40, 60)
    place = torch.stack([x - 30, y - 20])[None]
    # A stretch about the middle: forward x' = 1.4 x, backward exactly its inverse, so that x + forward closes.
    forward, backward = 0.4 * place, (1 / 1.4 - 1) * place
    seen = visible_in_both_images(forward, backward)
    stays = (1.4 * place[0, 0].abs() <= 29.5) & (1.4 * place[0, 1].abs() <= 19.5)
    assert torch.equal(seen[0, 0] > 0, stays)
    backward[..., 20:30] += 1.5  # a strip that goes elsewhere: 1.5^2 > 0.5 + 1 % of the motion
    hidden = (1.4 * place[0, 0] > -8.5) & (1.4 * place[0, 0] < -1.5) & stays
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

        # Noise of 0.02 in both: 0.02 * sqrt(2) * sqrt(2/pi) = 0.0226 in each of three colours; interpolation: a tenth.
        assert error(turned) < 1.1 * 3 * 0.0226
        assert error(turned) < min(error(0.8 * turned), error(1.2 * turned), error(flow.to(turned)))
        assert consistency_loss(turned, turned, pixels) == pytest.approx(0.01**0.4)
    flow, images = torch.rand(1, 2, 64, 64), torch.rand(2, 1, 3, 64, 64).unbind()
    one, again, other = (transformed_pair(*images, flow, random(seed))[0] for seed in (4, 4, 5))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
