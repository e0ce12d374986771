"""The integral equation that the solver is held against, itself held against published values and limits."""

import numpy as np
import pytest
from bonded_layer import ball, ball_at, compliance, punch_factor, respond, wave_numbers

PUNCH = {0.2: 1.281, 0.4: 1.684, 0.6: 2.213, 0.8: 2.860, 1.0: 3.619, 1.5: 6.003, 2.0: 9.149}
"""κ(a/h) of an incompressible layer: Lebedev & Ufliand (1958), Hayes et al. (1972)."""


@pytest.mark.parametrize("ratio", PUNCH)
def test_flat_punch_is_as_tabulated(ratio: float) -> None:
    assert punch_factor(3.0 * ratio, 3.0) == pytest.approx(PUNCH[ratio], abs=5e-4)  # the table's last digit


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.5])
def test_thick_layer_is_a_half_space(nu: float) -> None:
    """Boussinesq's punch and Hertz's ball, and the first correction 1 + c a/h with c = 2/π ∫ (1 - L) dx."""
    x, dx = wave_numbers()
    first = 2 / np.pi * dx @ (1 - compliance(x, nu))
    for ratio in (1e-2, 1e-3):
        # The next term is (c a/h)², c = 0.8 to 1.2.
        assert punch_factor(ratio, 1.0, nu) == pytest.approx(1 + first * ratio, abs=2 * ratio**2)
        depth, force = ball_at(ratio, 5.0, 1.0, nu)
        hertz = 4 / 3 / (1 - nu**2) * np.sqrt(5.0) * depth**1.5
        assert force == pytest.approx(hertz * (1 + first * ratio), rel=3 * ratio**2)


def test_thin_layer_is_lubrication_theory() -> None:
    """An incompressible film squeezed between a sticky and a slippery plate: P = 3π/8 μδ a⁴/h³ = κ 2 E a δ / (1 - ν²).

    A rim of fixed width beyond the edge takes part, so that the fourth root of the force is linear in a.
    """
    excess = [punch_factor(a, 1.0) / (3 * np.pi / 64 * a**3) for a in (4.0, 8.0)]
    rim = [(x**0.25 - 1) * a for x, a in zip(excess, (4.0, 8.0), strict=True)]
    # The rim's own width changes by O(h/a): 1.41 to 1.44.
    assert rim[0] == pytest.approx(rim[1], rel=0.05)
    assert 1 < rim[1] < 2


@pytest.mark.parametrize("nu", [0.4, 0.5])
def test_ball_on_a_layer_is_nearly_dimitriadis(nu: float) -> None:
    """Dimitriadis et al., Biophys. J. 82 (2002), eq. 12: a series in χ = sqrt(R δ)/h, of use at small χ only."""
    a0 = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    b0 = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1 - nu)
    pi = np.pi

    def series(chi: float) -> float:
        cubic = 8 / pi**3 * (a0**3 + 4 * pi**2 / 15 * b0)
        quartic = 16 * a0 / pi**4 * (a0**3 + 3 * pi**2 / 5 * b0)
        return 1 - 2 * a0 / pi * chi + 4 * a0**2 / pi**2 * chi**2 - cubic * chi**3 + quartic * chi**4

    for chi, tolerance in ((0.02, 5e-4), (0.05, 1e-3), (0.2, 0.015)):
        # a0 is a fit, good to 0.5 %; from χ = 0.2 on the series lacks the fifth power: 1 %.
        _, force = ball(chi**2 / 4.0, 4.0, 1.0, nu)
        hertz = 4 / 3 / (1 - nu**2) * np.sqrt(4.0) * (chi**2 / 4.0) ** 1.5
        assert force / hertz == pytest.approx(series(chi), rel=tolerance)


def test_ball_is_consistent_with_its_work() -> None:
    """At a fixed contact radius the force grows as the punch's: dP/dδ = 2 E a κ(a) / (1 - ν²)."""
    h = 1e-4
    contact, _ = ball(0.1, 4.0, 3.0)
    ahead, behind = ball(0.1 + h, 4.0, 3.0)[1], ball(0.1 - h, 4.0, 3.0)[1]
    slope = respond(contact, 3.0, 0.5)[0][0]
    assert (ahead - behind) / (2 * h) == pytest.approx(slope, rel=1e-5)  # h² / δ² = 1e-6 of the curvature
