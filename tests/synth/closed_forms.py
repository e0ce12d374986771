r"""Closed forms of the gel's law at finite strain: stress, uniaxial stretch, simple shear.

With s = I_1 - 3 - 2 \ln J and φ'(s) = 1 + 2 c_2 s + 3 c_3 s² the first Piola stress of the energy in
`synth.simulate.material` is

.. math::  P = μ φ'(s) (F - F^{-T}) + p J F^{-T}, \qquad p = λ (J - 1) \text{ (any } p \text{ where incompressible)}

Everything for E = 1. Written apart from the solver on purpose; shares no code with it.
"""

import numpy as np
from scipy.optimize import brentq

from synth.arrays import FloatArray

Stiffening = tuple[float, float]
NEO_HOOKEAN: Stiffening = (0.0, 0.0)
YEOH: Stiffening = (0.2, 0.05)  # C20/C10 and C30/C10 large enough to triple the stress at a stretch of two


def shear_modulus(poisson_ratio: float) -> float:
    """μ for E = 1."""
    return 1 / (2 * (1 + poisson_ratio))


def lame_modulus(poisson_ratio: float) -> float:
    """λ for E = 1; infinite at 0.5."""
    rest = 1 - 2 * poisson_ratio
    return poisson_ratio / ((1 + poisson_ratio) * rest) if rest > 0 else np.inf


def excess(F: FloatArray) -> FloatArray:
    """(...) the invariant s of deformation gradients (..., 3, 3)."""
    return np.asarray((F * F).sum(axis=(-2, -1)) - 3 - 2 * np.log(np.linalg.det(F)))


def piola(F: FloatArray, pressure: FloatArray, poisson_ratio: float, stiffening: Stiffening) -> FloatArray:
    """First Piola stress (..., 3, 3) at deformation gradients F and pressures (...)."""
    s, J = excess(F), np.linalg.det(F)
    inverse = np.swapaxes(np.linalg.inv(F), -1, -2)
    slope = shear_modulus(poisson_ratio) * (1 + 2 * stiffening[0] * s + 3 * stiffening[1] * s**2)
    return np.asarray(slope[..., None, None] * (F - inverse) + (pressure * J)[..., None, None] * inverse)


def uniaxial(stretch: float, poisson_ratio: float, stiffening: Stiffening) -> tuple[float, float]:
    """Lateral stretch and pulling force per undeformed area of a bar that is free sideways."""
    c2, c3 = stiffening
    mu, lame = shear_modulus(poisson_ratio), lame_modulus(poisson_ratio)
    if np.isinf(lame):  # 2 (l - l⁻²) (C10 + 2 C20 (I_1 - 3) + 3 C30 (I_1 - 3)²), Yeoh, Rubber Chem. Technol. 66 (1993)
        invariant = stretch**2 + 2 / stretch - 3
        return stretch**-0.5, (stretch - stretch**-2) * mu * (1 + 2 * c2 * invariant + 3 * c3 * invariant**2)

    def slope(t: float) -> float:
        s = stretch**2 + 2 * t**2 - 3 - 2 * np.log(stretch * t**2)
        return float(mu * (1 + 2 * c2 * s + 3 * c3 * s**2))

    def pressure_times_volume(t: float) -> float:
        return float(lame * (stretch * t**2 - 1) * stretch * t**2)

    # Otherwise the lateral stretch t is where the lateral stress vanishes; p = λ (l t² - 1).
    lateral = brentq(lambda t: slope(t) * (t - 1 / t) + pressure_times_volume(t) / t, 0.3, 3.0, xtol=1e-15)
    return lateral, slope(lateral) * (stretch - 1 / stretch) + pressure_times_volume(lateral) / stretch


def shear_traction(amount: float, poisson_ratio: float, stiffening: Stiffening) -> float:
    """Shear stress τ of F = I + γ e_x ⊗ e_z; it keeps the volume, I_1 - 3 = γ², and P = τ (e_x ⊗ e_z + e_z ⊗ e_x)."""
    c2, c3 = stiffening
    return float(shear_modulus(poisson_ratio) * amount * (1 + 2 * c2 * amount**2 + 3 * c3 * amount**4))
