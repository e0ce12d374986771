r"""Frictionless contact of a linear elastic layer bonded to a rigid base: the integral equation of the textbooks.

The layer's surface answers a pressure of Hankel transform p̄(ξ) with the sinking

.. math::  w(r) = \frac{2 (1 - ν²)}{E} ∫_0^∞ L(ξh) p̄(ξ) J_0(ξr) \, dξ, \qquad
           L(x) = \frac{2 K \sinh 2x - 4x}{2 K \cosh 2x + K² + 1 + 4x²}, \quad K = 3 - 4ν

(L = 1 is Boussinesq's half space). With p̄(ξ) = ∫_0^a φ(t) cos ξt dt the pressure vanishes outside r < a and

.. math::  φ(x) - \frac{2}{π} ∫_0^a φ(t) ∫_0^∞ (1 - L(ξh)) \cos ξx \cos ξt \, dξ \, dt
           = \frac{E}{π (1 - ν²)} \frac{d}{dx} ∫_0^x \frac{r w(r)}{\sqrt{x² - r²}} dr,  \qquad  P = 2π ∫_0^a φ dt.

The right side is proportional to δ for a flat punch and to δ - x²/R for a ball, whose contact radius a is where φ(a),
the strength of the pressure's singularity at the edge, vanishes. Lebedev & Ufliand, PMM 22 (1958); Hayes et al.,
J. Biomech. 5 (1972). Lengths in any unit; forces in units of E times length squared.
"""

from functools import cache

import numpy as np
from scipy.optimize import brentq

from synth.arrays import FloatArray

POINTS = 64
"""Gauss points over the contact radius: up to a = 10 h the force keeps 11 digits when they are doubled."""
CUTOFF = 30.0
"""1 - L(x) is 4 x² exp(-2x) at large x: 3e-23 at 30."""
WAVES = 400
"""Gauss points over the wave numbers: up to a = 10 h the force keeps 8 digits when they are quadrupled."""


def compliance(x: FloatArray, poisson_ratio: float) -> FloatArray:
    """L(x) of the module's docstring; both parts divided by exp(2x) so that no x overflows."""
    K, decay = 3 - 4 * poisson_ratio, np.exp(-2 * x)
    above = K * (1 - decay**2) - 4 * x * decay
    return np.asarray(above / (K * (1 + decay**2) + (K**2 + 1 + 4 * x**2) * decay))


@cache
def gauss(count: int) -> tuple[FloatArray, FloatArray]:
    """(count,) Gauss points on (-1, 1) and their weights; kept, for 400 are an eigenvalue problem."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


def wave_numbers() -> tuple[FloatArray, FloatArray]:
    """(WAVES,) points and weights for integrals over x = ξh from 0 to the cutoff."""
    nodes, weights = gauss(WAVES)
    return CUTOFF / 2 * (nodes + 1), CUTOFF / 2 * weights


def respond(radius: float, thickness: float, poisson_ratio: float) -> tuple[FloatArray, FloatArray]:
    """Solutions for the right sides 1 (all points sink alike) and x² (the ball's curvature), by Nyström's method.

    Args:
        radius: of the contact, a.
        thickness: of the layer, h.
        poisson_ratio: up to 0.5.

    Returns:
        (2,) forces over E and (2,) strengths φ(a) over E.
    """
    nodes, weights = gauss(POINTS)
    t, dt = radius / 2 * (nodes + 1), radius / 2 * weights
    wave, d_wave = wave_numbers()
    defect = 2 / (np.pi * thickness) * d_wave * (1 - compliance(wave, poisson_ratio))
    cosines = np.cos(np.outer(np.append(t, radius), wave / thickness))
    kernel = np.einsum("ik,k,jk->ij", cosines, defect, cosines[:-1]) * dt  # threads of a product would cost more
    right = np.append(t, radius)[:, None] ** (0, 2) / (np.pi * (1 - poisson_ratio**2))
    phi = np.linalg.solve(np.eye(POINTS) - kernel[:-1], right[:-1])
    return 2 * np.pi * dt @ phi, right[-1] + kernel[-1] @ phi


def punch_factor(radius: float, thickness: float, poisson_ratio: float = 0.5) -> float:
    """κ: the force of a flat punch over that on a half space, 2 E a δ / (1 - ν²)."""
    force, _ = respond(radius, thickness, poisson_ratio)
    return float(force[0] * (1 - poisson_ratio**2) / (2 * radius))


def ball_at(contact: float, radius: float, thickness: float, poisson_ratio: float = 0.5) -> tuple[float, float]:
    """Depth δ and force over E of a ball whose contact radius is `contact`."""
    force, edge = respond(contact, thickness, poisson_ratio)
    depth = edge[1] / (edge[0] * radius)
    return float(depth), float(depth * force[0] - force[1] / radius)


def ball(depth: float, radius: float, thickness: float, poisson_ratio: float = 0.5) -> tuple[float, float]:
    """Contact radius a and force over E of a ball pressed `depth` deep.

    On a half space a² = Rδ; a layer widens the contact, to a² = 4 Rδ at most (incompressible and infinitely thin).
    """
    half_space = np.sqrt(radius * depth)
    contact = brentq(
        lambda a: ball_at(a, radius, thickness, poisson_ratio)[0] - depth, 0.9 * half_space, 2 * half_space, xtol=1e-12
    )
    return float(contact), ball_at(contact, radius, thickness, poisson_ratio)[1]
