"""Each term of the loss: closed forms, invariances, masks, and gradients against finite differences."""

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck
from waves import moved_pair, pixel_centres, press_flow

from gelflow.config import LossConfig
from gelflow.losses import self_supervised_loss
from gelflow.losses.decomposition import decomposition_loss, regulariser_weight
from gelflow.losses.deformation import area_ratio, deformation_loss
from gelflow.losses.endpoint import endpoint_loss
from gelflow.losses.photometric import C1, C2, appearance_loss, photometric_loss, structural_similarity
from gelflow.losses.smoothness import first_order_loss
from gelflow.ops.pyramid import flow_pyramid, image_pyramid
from gelflow.ops.warp import warp


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
    loss = photometric_loss(image, image, torch.zeros(1, 2, 12, 15, dtype=torch.float64))
    # warping errs by 1e-14; SSIM is 1 up to 1e-14 / C2
    assert 0 <= loss + 1e-11 < 2e-11
    image1, image2 = torch.rand(2, 1, 3, 1, 1, dtype=torch.float64)
    loss = photometric_loss(image1, image2, torch.zeros(1, 2, 1, 1, dtype=torch.float64), alpha=0)
    assert abs(loss - (image1 - image2).abs().mean()) < 1e-15
    flow = torch.zeros(2, 64, 64, dtype=torch.float64)
    flow[0] = 10
    image1, image2 = (image[None] for image in moved_pair(flow, seed=4))
    assert photometric_loss(image1, image2, flow[None]) < 1e-9  # an integer shift: exact but for rounding, as above
    assert appearance_loss(image1, warp(image2, flow[None]), torch.ones(1, 1, 64, 64), 0.85) > 0.01
    assert photometric_loss(image1, image2, flow[None] * 100) == 0  # nothing left to judge by


@pytest.mark.parametrize("largest", [2.0, 4.0])
def test_the_true_flow_scores_better_than_none_and_than_a_tenth_more_or_less_at_every_scale(largest: float) -> None:
    flow = press_flow(120, 160, largest)
    images = [image_pyramid(image[None], 3) for image in moved_pair(flow, seed=3, shortest=16, longest=48)]
    for scale, true in enumerate(flow_pyramid(flow[None], 3)):
        losses = {f: photometric_loss(images[0][scale], images[1][scale], f * true).item() for f in (0, 0.9, 1, 1.1)}
        assert losses[1] < min(losses[0.9], losses[1.1]) < losses[0]


ONES = torch.ones(1, 1, 9, 11, dtype=torch.float64)


def affine_flow(matrix: list[list[float]], shift: tuple[float, float] = (1.5, -0.7)) -> Tensor:
    """(1, 2, 10, 12) float64: V = matrix (x, y) + shift."""
    x, y = pixel_centres(10, 12)
    return torch.stack([m[0] * x + m[1] * y + s for m, s in zip(matrix, shift, strict=True)])[None]


@pytest.mark.parametrize(
    ("matrix", "parts"),
    [
        ([[0, 0], [0, 0]], (0, 0, 0)),  # translation
        ([[0.2, 0], [0, -0.1]], (0.3, 0, 0)),  # stretch: |e_xx| + |e_yy|
        ([[0, 0.1], [0.1, 0]], (0, 0.2, 0)),  # pure shear: 2 |e_xy|
        ([[0, -0.1], [0.1, 0]], (0, 0, 0.2)),  # rotation: 2 |omega|
        ([[0.1, 0.3], [-0.05, 0.2]], (0.3, 0.25, 0.35)),
    ],
)
def test_decomposition_separates_stretch_shear_and_rotation_and_affine_flows_cost_no_deformation(matrix, parts) -> None:
    flow = affine_flow(matrix)
    loss = decomposition_loss(flow, ONES, lambda_theta=10, lambda_zeta=100)
    # 100 times differences of numbers up to 5, in double precision
    assert loss.item() == pytest.approx(parts[0] + 10 * parts[1] + 100 * parts[2], abs=1e-11)
    assert (first_order_loss(flow, torch.rand(1, 3, 10, 12, dtype=torch.float64)) == 0) == (not any(parts))
    for ratio in ("product", "det"):
        # rounding: numbers up to 5 give slopes good to 1e-15
        assert deformation_loss(flow, ONES, ratio) < 1e-13


def test_area_ratios_of_a_stretch_and_of_a_rotation_and_the_cost_of_a_growing_stretch() -> None:
    c, s = math.cos(0.1) - 1, math.sin(0.1)
    stretch, turn = affine_flow([[0.25, 0], [0, -0.2]]), affine_flow([[c, -s], [s, c]])
    for flow, ratio, expected in ((stretch, "product", 1.25 * 0.8), (turn, "det", 1), (turn, "product", (c + 1) ** 2)):
        assert area_ratio(flow, ratio).sub(expected).abs().max() < 1e-13
    x, _ = pixel_centres(10, 12)
    flow = torch.stack([0.05 * x**2, torch.zeros_like(x)])[None]  # R = 1 + 0.1 x: gradient 0.1 along x
    assert deformation_loss(flow, ONES).item() == pytest.approx(0.1, abs=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 9)])
def test_scales_too_small_for_a_derivative_cost_nothing_and_keep_the_gradient_defined(size: tuple[int, int]) -> None:
    flow = torch.randn(1, 2, *size, requires_grad=True)
    weight, image = torch.ones(1, 1, size[0] - 1, size[1] - 1), torch.rand(1, 3, *size)
    loss = deformation_loss(flow, weight)
    if size[0] == 1:
        loss = loss + decomposition_loss(flow, weight) + first_order_loss(flow, image)
    loss.backward()
    assert loss == 0
    assert not flow.grad.any()


def test_first_order_smoothness_and_weights_follow_their_definition_at_edges() -> None:
    image = torch.zeros(1, 3, 4, 6, dtype=torch.float64)
    image[..., 3:] = 1
    flow = torch.zeros(1, 2, 4, 6, dtype=torch.float64)
    flow[:, 0, :, 3:] = 2
    # 3 x 5 pixels, 3 of them at the jump: 2 px times exp(-10), halved
    assert first_order_loss(flow, image).item() == pytest.approx(3 / 15 * 2 * math.exp(-10) / 2, rel=1e-12)
    assert first_order_loss(flow, torch.zeros_like(image)).item() == pytest.approx(3 / 15 * 2 / 2, rel=1e-12)
    image = torch.zeros(1, 3, 3, 4, dtype=torch.float64)
    image[0, :, :, 2:] = torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64).view(3, 1, 1)  # |grad I| = 0.2 in the mean
    edge = math.exp(-10 * 0.2)
    for kind, on, off in (("anti_edge", 1 - edge, 0), ("edge_aware", edge, 1), ("floor", 1 - edge, 0.1)):
        weight = regulariser_weight(image, kind, 10.0, 0.1)
        assert weight.shape == (1, 1, 2, 3)
        expected = torch.tensor([off, on, off], dtype=torch.float64).expand(1, 1, 2, 3)
        torch.testing.assert_close(weight, expected, rtol=0, atol=1e-14)


ALONE = {"alpha": 0.5, "lambda_dc": 0.0, "lambda_df": 0.0}
REGULARISER = {"alpha": 0.0, "lambda_dc": 3.0, "lambda_df": 0.0}
TERMS = {
    "absolute difference": {**ALONE, "alpha": 0.0},
    "structural similarity": {**ALONE, "alpha": 1.0},
    "spline": {**ALONE, "warping": "spline"},
    "on the images": {**ALONE, "compare_at": "image"},
    "decomposition": REGULARISER,
    "decomposition, in px": {**REGULARISER, "flow_normalisation": "none"},
    "edge-aware weight": {**REGULARISER, "weight": "edge_aware"},
    "floored weight": {**REGULARISER, "weight": "floor", "weight_floor": 0.9},
    "deformation": {**REGULARISER, "lambda_dc": 0.0, "lambda_df": 3.0},
    "deformation, determinant": {**REGULARISER, "lambda_dc": 0.0, "lambda_df": 3.0, "ratio": "det"},
    "first order": {**REGULARISER, "smoothness": "first_order"},
    "second order": {**REGULARISER, "smoothness": "second_order"},
    "second order, its own weights": {**REGULARISER, "smoothness": "second_order", "smoothness_s": (0.0, 2.0)},
}


@pytest.mark.parametrize("masked", [False, True], ids=["all pixels", "some hidden"])
@pytest.mark.parametrize("term", list(TERMS))
def test_the_gradient_is_that_of_finite_differences(term: str, masked: bool) -> None:
    random = torch.Generator().manual_seed(5)

    def noise(*size: int) -> Tensor:
        return 0.2 * torch.rand(*size, generator=random, dtype=torch.float64)

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


def test_the_endpoint_loss_pulls_towards_the_truth_with_unit_length() -> None:
    """Its gradient is the direction to the truth over the number of pixels; at the truth it vanishes."""
    random = torch.Generator().manual_seed(6)
    truth = torch.randn(1, 2, 4, 5, generator=random, dtype=torch.float64)
    angle = 6.3 * torch.rand(1, 1, 4, 5, generator=random, dtype=torch.float64)
    length = 0.5 + torch.rand(1, 1, 4, 5, generator=random, dtype=torch.float64)
    flow = (truth + length * torch.cat([angle.cos(), angle.sin()], dim=1)).requires_grad_()
    assert gradcheck(lambda f: endpoint_loss(f, truth), (flow,))
    (gradient,) = torch.autograd.grad(endpoint_loss(flow, truth), flow)
    away = (flow - truth).detach()
    # |d| / sqrt(d^2 + 0.01^2) differs from 1 by 5e-5 / d^2, and d is at least 0.5 px.
    torch.testing.assert_close(20 * gradient, away / away.norm(dim=1, keepdim=True), rtol=0, atol=2.1e-4)
    at_truth = truth.clone().requires_grad_()
    assert not torch.autograd.grad(endpoint_loss(at_truth, truth), at_truth)[0].any()
