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

Also the layer's finite elements: a quarter with walls of symmetry at x = 0 and y = 0, bonded at z = thickness, free at
the rim. The square grid's rings become circles, so that few elements resolve a round contact.
"""

from collections.abc import Callable
from functools import cache, partial

import numpy as np
from pads import found_by_newton, indenters, mapped, scene, supported
from scipy.optimize import brentq

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import PadMesh
from synth.mesh.element import Element
from synth.scene import Numerics
from synth.simulate.contact_friction import Indenters
from synth.simulate.material import uniform
from synth.simulate.system import System

POINTS = 64  # Gauss points over the contact radius: up to a = 10 h the force keeps 11 digits when they are doubled
CUTOFF = 30.0  # 1 - L(x) is 4 x² exp(-2x) at large x: 3e-23 at 30
WAVES = 400  # Gauss points over the wave numbers: up to a = 10 h the force keeps 8 digits when they are quadrupled


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


def waves() -> tuple[FloatArray, FloatArray]:
    """(WAVES,) points and weights for integrals over x = ξh from 0 to the cutoff."""
    nodes, weights = gauss(WAVES)
    return CUTOFF / 2 * (nodes + 1), CUTOFF / 2 * weights


def flat_and_ball(x: FloatArray) -> FloatArray:
    """Right sides (n, 2): 1 where all points sink alike, and x² of a ball."""
    return np.asarray(x[:, None] ** (0, 2))


def respond(
    contact: float, thickness: float, poisson_ratio: float, right: Callable = flat_and_ball, points: int = POINTS
) -> tuple[FloatArray, FloatArray]:
    """Forces (k,) and strengths φ(a) (k,) over E for right sides (n, k) of places x (n,), by Nyström's method."""
    nodes, weights = gauss(points)
    t, dt = contact / 2 * (nodes + 1), contact / 2 * weights
    wave, d_wave = waves()
    defect = 2 / (np.pi * thickness) * d_wave * (1 - compliance(wave, poisson_ratio))
    x = np.append(t, contact)
    cosines = np.cos(np.outer(x, wave / thickness))
    kernel = (cosines * defect) @ cosines[:-1].T * dt
    given = right(x) / (np.pi * (1 - poisson_ratio**2))
    phi = np.linalg.solve(np.eye(points) - kernel[:-1], given[:-1])
    return 2 * np.pi * dt @ phi, given[-1] + kernel[-1] @ phi


def kappa(radius: float, thickness: float, poisson_ratio: float = 0.5) -> float:
    """κ: the force of a flat punch over that on a half space, 2 E a δ / (1 - ν²)."""
    force, _ = respond(radius, thickness, poisson_ratio)
    return float(force[0] * (1 - poisson_ratio**2) / (2 * radius))


def flat_and_sphere(x: FloatArray, radius: float) -> FloatArray:
    """The same (n, 2) of a true sphere, which is steeper than its parabola: R x artanh(x/R) in place of x²."""
    return np.column_stack([np.ones_like(x), radius * x * np.arctanh(x / radius)])


def ball_at(
    contact: float, radius: float, thickness: float, poisson_ratio: float = 0.5, right: Callable = flat_and_ball
) -> tuple[float, float]:
    """Depth δ and force over E of a ball whose contact radius is `contact`."""
    force, edge = respond(contact, thickness, poisson_ratio, right)
    depth = edge[1] / (edge[0] * radius)
    return float(depth), float(depth * force[0] - force[1] / radius)


def ball(
    depth: float, radius: float, thickness: float, poisson_ratio: float = 0.5, right: Callable = flat_and_ball
) -> tuple[float, float]:
    """Contact radius a and force over E of a ball pressed `depth` deep."""
    half_space = np.sqrt(radius * depth)  # a layer widens the contact, to twice that at most
    found = partial(ball_at, radius=radius, thickness=thickness, poisson_ratio=poisson_ratio, right=right)
    contact = brentq(lambda a: found(a)[0] - depth, 0.9 * half_space, 2 * half_space, xtol=1e-12)
    return float(contact), found(contact)[1]


TOLERANCE = 1e-7  # Of the relative residual; a thousand times below the discretisation error


def disc(radii: FloatArray, depths: FloatArray, half: bool = False) -> PadMesh:
    """A quarter or the half y >= 0, with rings at radii and planes at depths, both from 0 (mm).

    Ring k is a polygon of 2 k edges over a quarter; it encloses as much as the circle does.
    """
    rings, planes = len(radii) - 1, len(depths) - 1
    angle_of_edge = np.pi / 4 / np.arange(1, rings + 1)
    corners = np.append(0.0, radii[1:] * np.sqrt(angle_of_edge / np.sin(angle_of_edge)))

    def bend(cube: Points) -> Points:
        along, across = (1 + half) * cube[:, 0] - half, cube[:, 1]
        large, small = np.maximum(np.abs(along), across), np.minimum(np.abs(along), across)
        radius = np.interp(large * rings, np.arange(rings + 1), corners)
        angle = np.pi / 4 * small / np.where(large > 0, large, 1.0)
        angle = np.where(np.abs(along) >= across, angle, np.pi / 2 - angle)
        depth = np.interp(cube[:, 2] * planes, np.arange(planes + 1), depths)
        return np.column_stack([np.sign(along) * radius * np.cos(angle), radius * np.sin(angle), depth])

    return mapped(((1 + half) * rings, rings, planes), bend, float(depths[-1]))


def punch_disc(radius: float, thickness: float, cells: int, ratio: float) -> PadMesh:
    """A quarter whose rings narrow toward a punch's edge from both sides."""
    towards_edge = radius - growing(0.0, radius, cells, ratio)[::-1]
    radii = np.concatenate([[0.0], towards_edge[1:], [radius], growing(radius, 2.5 * thickness, cells + 1, ratio)])
    return disc(radii, np.concatenate([[0.0], growing(0.0, thickness, cells, 1.4)]))


def growing(start: float, length: float, count: int, ratio: float) -> FloatArray:
    """(count,) positions beyond start, to start + length, whose spacing grows by ratio."""
    share = np.cumsum(ratio ** np.arange(count))
    return np.asarray(start + length * share / share[-1])


def walls_and_window(points: Points, half: bool = False) -> BoolArray:
    """Smooth walls at y = 0 and, of a quarter, at x = 0; glued to the window."""
    window = points[:, 2] == points[:, 2].max()
    return np.column_stack([window | (points[:, 0] == 0) & (not half), window | (points[:, 1] == 0), window])


def body(mesh: PadMesh, element: Element, poisson_ratio: float) -> System:
    """The quarter's system for a material of E = 1."""
    return System(supported(mesh, element, walls_and_window), uniform(len(mesh.tets), poisson_ratio))


def lowered(shape: dict[str, object], depth: float, thickness: float) -> Indenters:
    """An indenter whose lowest point is `depth` past the face."""
    return indenters(scene((20.0, 20.0, thickness), indenter=shape, motion={"depth_mm": depth}), depth)


def press(quarter: System, indenter: Indenters, penalties: tuple[float, ...] = (20.0, 200.0)) -> float:
    """Force of the whole layer over E, mm²: at rising penalties, then with updates that leave less than 0.5 % of it."""
    sharpness = float(indenter.stiffness.numpy()[0]) / Numerics().penalty
    state, residual = quarter.zero(), quarter.residual(quarter.zero(), indenter)
    for k in range(len(penalties) + 2):
        if k < len(penalties):
            indenter.stiffness.fill_(penalties[k] * sharpness)
        else:
            quarter.augment(residual, indenter)
        solution = found_by_newton(quarter, state, indenter, TOLERANCE)
        assert solution.converged, f"solve {k}: residual {solution.relative:.1e}"
        state, residual = solution.state, solution.residual
    return 4 * float(quarter.forces(state, residual)[0][2])


def ball_ratio(element: Element, poisson_ratio: float, radius: float, depth: float, cells: int) -> float:
    """Force of a ball over the integral equation's: `cells` across the contact, beside it, and through a layer of 1."""
    contact, force = ball(depth, radius, 1.0, poisson_ratio)
    reach = 1.15 * contact
    radii = np.concatenate([np.linspace(0, reach, cells + 1), growing(reach, 2.5, cells, 1.5)])
    quarter = body(disc(radii, np.append(0.0, growing(0.0, 1.0, cells, 1.3))), element, poisson_ratio)
    return press(quarter, lowered({"shape": "sphere", "radius_mm": radius}, depth, 1.0)) / force
