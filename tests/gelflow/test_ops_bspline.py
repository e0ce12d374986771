"""Cubic B-spline grids: reproduction of affine fields, order of approximation, adjoint, bending energy."""

import pytest
import torch

from gelflow.ops.bspline import SplineGrid, spline_basis

LIKE = torch.zeros((), dtype=torch.float64)


@pytest.mark.parametrize(("pixels", "spacing"), [(64, 8), (65, 8), (71, 16), (9, 32)])
def test_constant_and_affine_fields_are_reproduced(pixels: int, spacing: int) -> None:
    """Fails with 2/3 - d^2 + d^3/3 in place of 2/3 - d^2 + d^3/2 as the inner part of the spline."""
    basis = spline_basis(pixels, spacing, LIKE)
    places = spacing * (torch.arange(basis.shape[1], dtype=torch.float64) - 1)
    # Exact but for rounding: float64, values below 100.
    torch.testing.assert_close(basis.sum(dim=1), torch.ones(pixels, dtype=torch.float64))
    torch.testing.assert_close(basis @ places, torch.arange(pixels, dtype=torch.float64), rtol=0, atol=1e-11)
    assert (basis.abs().sum(dim=0) > 0).all(), "a control point without any pixel"


def test_smooth_fields_are_approximated_to_fourth_order() -> None:
    """Fails with a spline of second order, max(0, 1 - d), whose error falls by 4."""
    wave = torch.sin(torch.arange(193, dtype=torch.float64) * 2 * torch.pi / 96)
    errors = []
    for spacing in (24, 12, 6):
        basis = spline_basis(193, spacing, LIKE)
        best = torch.linalg.lstsq(basis, wave[:, None]).solution
        errors.append((basis @ best - wave[:, None]).square().mean().sqrt().item())
    # 2^4 = 16 asymptotically; at 4 points a wave it is not quite reached.
    assert errors[0] / errors[1] > 12
    assert errors[1] / errors[2] > 12


def test_the_adjoint_is_the_adjoint_and_the_diagonal_its_diagonal() -> None:
    """Fails with the rows' basis used for the columns."""
    generator = torch.Generator().manual_seed(0)
    grid = SplineGrid(20, 33, 8, LIKE)
    points = torch.rand(2, 2, *grid.shape, generator=generator, dtype=torch.float64)
    field = torch.rand(2, 2, 20, 33, generator=generator, dtype=torch.float64)
    torch.testing.assert_close((grid.field(points) * field).sum(), (points * grid.adjoint(field)).sum())
    unit = torch.zeros_like(points[:1, :1])
    unit[0, 0, 2, 3] = 1
    weight = field[:1, :1]
    entry = grid.adjoint(weight * grid.field(unit))[0, 0, 2, 3]
    torch.testing.assert_close(grid.diagonal(weight)[0, 0, 2, 3], entry)


def test_bending_is_that_of_the_field() -> None:
    """Half the gradient times the points is the energy, which for V = a x^2 + b x y is S^2 (4 a^2 + 2 b^2) a pixel.

    Fails with the mixed derivative counted once.
    """
    grid = SplineGrid(161, 161, 8, LIKE)
    rows, columns = [8.0 * torch.arange(size, dtype=torch.float64) for size in grid.shape]
    a, b = 3e-3, 2e-3
    points = (a * columns.square() + b * rows[:, None] * columns).view(1, 1, *grid.shape)
    energy = (points * grid.bending(points)).sum() / (161 * 161)
    # Differences reach over m - 2 (second) and m - 1 (mixed) of the m = 23 points of a side: 9 % less at most.
    assert energy.item() == pytest.approx(64 * (4 * a * a + 2 * b * b), rel=0.09)
    assert energy.item() < 64 * (4 * a * a + 2 * b * b)
    flat = (a * columns + b * rows[:, None]).view(1, 1, *grid.shape)
    assert grid.bending(flat).abs().max() < 1e-12
