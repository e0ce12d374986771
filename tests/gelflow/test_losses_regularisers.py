"""Decomposition, deformation and first-order smoothness: closed forms and invariances."""

import math

import pytest
import torch
from torch import Tensor
from waves import pixel_centres

from gelflow.losses.decomposition import decomposition_loss
from gelflow.losses.deformation import area_ratio, deformation_loss
from gelflow.losses.smoothness import first_order_loss
from gelflow.losses.weight import regulariser_weight

ONES = torch.ones(1, 1, 9, 11, dtype=torch.float64)


def affine_flow(matrix: list[list[float]], shift: tuple[float, float] = (1.5, -0.7)) -> Tensor:
    """(1, 2, 10, 12) float64: V = matrix (x, y) + shift."""
    x, y = pixel_centres(10, 12)
    return torch.stack([m[0] * x + m[1] * y + s for m, s in zip(matrix, shift, strict=True)])[None]


def test_a_translation_costs_nothing() -> None:
    flow, image = affine_flow([[0, 0], [0, 0]]), torch.rand(1, 3, 10, 12, dtype=torch.float64)
    assert decomposition_loss(flow, ONES) == 0
    assert first_order_loss(flow, image) == 0


@pytest.mark.parametrize(
    ("matrix", "parts"),
    [
        ([[0.2, 0], [0, -0.1]], (0.3, 0, 0)),  # stretch: |e_xx| + |e_yy|
        ([[0, 0.1], [0.1, 0]], (0, 0.2, 0)),  # pure shear: 2 |e_xy|
        ([[0, -0.1], [0.1, 0]], (0, 0, 0.2)),  # rotation: 2 |omega|
        ([[0.1, 0.3], [-0.05, 0.2]], (0.3, 0.25, 0.35)),
    ],
)
def test_decomposition_separates_stretch_shear_and_rotation(matrix: list, parts: tuple) -> None:
    loss = decomposition_loss(affine_flow(matrix), ONES, lambda_theta=10, lambda_zeta=100)
    # 100 times differences of numbers up to 5, in double precision
    assert loss.item() == pytest.approx(parts[0] + 10 * parts[1] + 100 * parts[2], abs=1e-11)


@pytest.mark.parametrize("ratio", ["product", "det"])
@pytest.mark.parametrize("matrix", [[[0.2, 0.1], [-0.3, -0.1]], [[0, 0], [0, 0]], [[0, -0.1], [0.1, 0]]])
def test_an_affine_flow_costs_no_deformation(matrix: list, ratio: str) -> None:
    # rounding: numbers up to 5 give slopes good to 1e-15
    assert deformation_loss(affine_flow(matrix), ONES, ratio) < 1e-13


def test_area_ratios_of_a_stretch_and_of_a_rotation() -> None:
    stretch = affine_flow([[0.25, 0], [0, -0.2]])
    assert area_ratio(stretch, "product").sub(1.25 * 0.8).abs().max() < 1e-13
    angle = 0.1
    turn = affine_flow([[math.cos(angle) - 1, -math.sin(angle)], [math.sin(angle), math.cos(angle) - 1]])
    assert area_ratio(turn, "det").sub(1).abs().max() < 1e-13
    assert area_ratio(turn, "product").sub(math.cos(angle) ** 2).abs().max() < 1e-13  # 0.990, as FACTS says


def test_a_growing_stretch_costs_its_gradient() -> None:
    x, _ = pixel_centres(10, 12)
    flow = torch.stack([0.05 * x**2, torch.zeros_like(x)])[None]  # R = 1 + 0.1 x: gradient 0.1 along x
    assert deformation_loss(flow, ONES).item() == pytest.approx(0.1, abs=1e-12)


def test_scales_too_small_for_a_derivative_cost_nothing_and_keep_the_gradient_defined() -> None:
    for size in ((1, 1), (1, 5), (3, 9)):
        flow = torch.randn(1, 2, *size, requires_grad=True)
        weight, image = torch.ones(1, 1, size[0] - 1, size[1] - 1), torch.rand(1, 3, *size)
        loss = deformation_loss(flow, weight)
        if size[0] == 1:
            loss = loss + decomposition_loss(flow, weight) + first_order_loss(flow, image)
        loss.backward()
        assert loss == 0
        assert not flow.grad.any()


def test_first_order_smoothness_is_waived_at_edges_of_the_same_direction() -> None:
    image = torch.zeros(1, 3, 4, 6, dtype=torch.float64)
    image[..., 3:] = 1
    flow = torch.zeros(1, 2, 4, 6, dtype=torch.float64)
    flow[:, 0, :, 3:] = 2
    # 3 x 5 pixels, 3 of them at the jump: 2 px times exp(-10), halved
    assert first_order_loss(flow, image).item() == pytest.approx(3 / 15 * 2 * math.exp(-10) / 2, rel=1e-12)
    assert first_order_loss(flow, torch.zeros_like(image)).item() == pytest.approx(3 / 15 * 2 / 2, rel=1e-12)


def test_weights_follow_their_definition() -> None:
    image = torch.zeros(1, 3, 3, 4, dtype=torch.float64)
    image[0, :, :, 2:] = torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64).view(3, 1, 1)  # |grad I| = 0.2 in the mean
    edge = math.exp(-10 * 0.2)
    for kind, on, off in (("anti_edge", 1 - edge, 0), ("edge_aware", edge, 1), ("floor", 1 - edge, 0.1)):
        weight = regulariser_weight(image, kind, 10.0, 0.1)
        assert weight.shape == (1, 1, 2, 3)
        expected = torch.tensor([off, on, off], dtype=torch.float64).expand(1, 1, 2, 3)
        torch.testing.assert_close(weight, expected, rtol=0, atol=1e-14)
