"""Uniform finite strain against closed forms: uniaxial stretch and simple shear, from Poisson's ratio 0 to 0.5.

The bodies are irregular meshes, supported so that the strain is uniform; linear and quadratic elements both contain the
exact solution, so that only Newton's tolerance (1e-10 of the forces, `pads.TIGHT`) and the conditioning separate
them from it.

Rates: a unit cube, held as the exact solution says on all faces but z = 0, is bent by a smooth deformation. Its dead
nodal loads are ∫ P ∇N_a of the exact stress, by a rule of degree 5 or more: body force and surface traction at once,
whose equations the exact solution satisfies with any test function. (With more faces free the dead loads make it
buckle.) Interpolation theory then gives errors of order h^(k+1) in displacement and h^k in its gradient for elements of
degree k, and h² in the pressure of P2/P1 (Boffi, Brezzi & Fortin, Mixed Finite Element Methods, 2013, sec. 8.8);
P1/P1's pressure is of order 1.5 or better on smooth meshes (at least 1: Dohrmann & Bochev 2004).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from closed_forms import NEO_HOOKEAN, YEOH, Stiffening, lame_modulus, piola, shear_traction, uniaxial
from integrals import integrals
from pads import crooked, equilibrium, face_load, layered, mapped, supported

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import PadMesh
from synth.mesh.element import Element, p1p1, p2p1
from synth.simulate.material import Material, uniform
from synth.simulate.space import Space
from synth.simulate.system import Unknowns

MESH = crooked()
LENGTH, WIDTH, HEIGHT = MESH.size_mm
RATIOS = [0.0, 0.2, 0.3, 0.4999, 0.5]
ELEMENTS: list[Callable[[], Element]] = [p1p1, p2p1]
CLOSE = 1e-8
"""Newton stops at 1e-10 of the nodal forces; the softest modes of these coarse meshes give way 100 times as much."""


def bar(points: Points) -> BoolArray:
    """Drawn along x between two smooth plates, leaning on smooth walls at y = -WIDTH/2 and z = HEIGHT."""
    held = np.zeros(points.shape, dtype=bool)
    held[:, 0] = np.abs(points[:, 0]) == LENGTH / 2
    held[:, 1] = points[:, 1] == -WIDTH / 2
    held[:, 2] = points[:, 2] == HEIGHT
    return held


def plates(points: Points) -> BoolArray:
    """Glued to plates at z = 0 and z = HEIGHT."""
    return np.repeat(((points[:, 2] == 0) | (points[:, 2] == HEIGHT))[:, None], 3, axis=1)


def check_bar(space: Space, material: Material, stretches: tuple[float, float], pull: float, steps: int) -> FloatArray:
    """Draw a bar to its longitudinal and lateral stretch: uniform strain, a pulling force, and all nodal forces."""
    stretch, lateral = stretches
    corner = np.array([-LENGTH / 2, -WIDTH / 2, HEIGHT])
    exact = (space.points - corner) * (np.array([stretch, lateral, lateral]) - 1)
    _, state, force = equilibrium(space, material, exact, steps=steps)
    np.testing.assert_allclose(state.u, exact, atol=CLOSE)
    assert force[space.points[:, 0] == LENGTH / 2, 0].sum() == pytest.approx(pull, rel=CLOSE)
    return force


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("stiffening", [NEO_HOOKEAN, YEOH])
@pytest.mark.parametrize("nu", RATIOS)
@pytest.mark.parametrize("stretch", [1.5, 0.7])
def test_uniaxial_stretch(stretch: float, nu: float, stiffening: Stiffening, element: Callable[[], Element]) -> None:
    space = supported(MESH, element(), bar)
    lateral, stress = uniaxial(stretch, nu, stiffening)
    material = uniform(len(MESH.tets), nu, stiffening)
    force = check_bar(space, material, (stretch, lateral), stress * WIDTH * HEIGHT, steps=8)
    # The smooth walls feel nothing: lateral stress vanishes.
    np.testing.assert_allclose(force[:, 1:], 0.0, atol=CLOSE)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("stiffening", [NEO_HOOKEAN, YEOH])
@pytest.mark.parametrize("nu", RATIOS)
def test_simple_shear(nu: float, stiffening: Stiffening, element: Callable[[], Element]) -> None:
    """Between glued plates, with the shear traction of the closed form as a dead load on the ends: γ = 0.8."""
    gamma, space = 0.8, supported(MESH, element(), plates)
    exact = np.zeros_like(space.points)
    exact[:, 0] = gamma * (space.points[:, 2] - HEIGHT)
    tau = shear_traction(gamma, nu, stiffening)
    right = face_load(space, lambda x: x[:, 0] == LENGTH / 2, np.array([0.0, 0.0, tau]))
    left = face_load(space, lambda x: x[:, 0] == -LENGTH / 2, np.array([0.0, 0.0, -tau]))
    material = uniform(len(MESH.tets), nu, stiffening)
    _, state, force = equilibrium(space, material, exact, left + right, steps=8)
    np.testing.assert_allclose(state.u, exact, atol=CLOSE)
    np.testing.assert_allclose(state.p, 0.0, atol=100 * CLOSE)  # the pressure is per volume change, the stiffest mode
    window = force[space.points[:, 2] == HEIGHT].sum(axis=0)
    np.testing.assert_allclose(window, [tau * LENGTH * WIDTH, 0.0, 0.0], atol=CLOSE * LENGTH * WIDTH)


@pytest.mark.parametrize("element", ELEMENTS)
def test_layers_side_by_side_stretch_alike(element: Callable[[], Element]) -> None:
    """Two incompressible layers drawn along their interface: each bears its own stress, and so its own pressure."""
    stretch, nu, ratio = 1.3, 0.5, 30.0
    lateral, yeoh = uniaxial(stretch, nu, YEOH)
    _, neo_hookean = uniaxial(stretch, nu, NEO_HOOKEAN)
    points = MESH.points.copy()
    middle = np.abs(points[:, 2] - HEIGHT / 2) < 0.4 * HEIGHT / 2
    points[middle, 2] = HEIGHT / 2  # a flat interface; the rest stays crooked
    mesh = layered(PadMesh(points, MESH.tets, MESH.size_mm), HEIGHT / 2)
    assert mesh.volumes.min() > 0
    soft, above = uniform(len(mesh.tets), nu), mesh.layer == 1
    shear = np.where(above, soft.shear, ratio * soft.shear)
    material = Material(shear, soft.lame, np.where(above[:, None], 0.0, YEOH), soft.mixed)
    space = supported(mesh, element(), bar)
    check_bar(space, material, (stretch, lateral), (ratio * yeoh + neo_hookean) * WIDTH * HEIGHT / 2, steps=4)


class Exact(NamedTuple):
    """Manufactured fields at undeformed points (..., 3): displacement, F, and pressure."""

    u: FloatArray
    F: FloatArray
    p: FloatArray


def gradient(points: Points, entries: dict[tuple[int, int], FloatArray]) -> FloatArray:
    F = np.broadcast_to(np.eye(3), (*points.shape, 3)).copy()
    for (i, j), values in entries.items():
        F[..., i, j] = values
    return F


def bent(X: Points, swelling: float) -> Exact:
    """Two shears one after the other, each of unit determinant, then a stretch of z that changes the volume.

    x = X + 0.3 (1 - Z) sin 2Y;  y = Y + 0.2 cos 2x sin Z;  z = Z + swelling (sin X) (1 - Z)
    """
    A, B = 0.3, 0.2
    x = X[..., 0] + A * (1 - X[..., 2]) * np.sin(2 * X[..., 1])
    first = gradient(X, {(0, 1): 2 * A * (1 - X[..., 2]) * np.cos(2 * X[..., 1]), (0, 2): -A * np.sin(2 * X[..., 1])})
    Z = X[..., 2]
    y = X[..., 1] + B * np.cos(2 * x) * np.sin(Z)
    second = gradient(X, {(1, 0): -2 * B * np.sin(2 * x) * np.sin(Z), (1, 2): B * np.cos(2 * x) * np.cos(Z)})
    z = Z + swelling * np.sin(x) * (1 - Z)
    third = gradient(X, {(2, 0): swelling * np.cos(x) * (1 - Z), (2, 2): 1 - swelling * np.sin(x)})
    F = third @ second @ first
    return Exact(np.stack([x, y, z], axis=-1) - X, F, 0.2 * np.cos(X[..., 0] + X[..., 1]) * X[..., 2])


def skewed(cube: Points) -> Points:
    """A smooth map of the cube onto itself, so that no element is a copy of its neighbour."""
    x, y, z = cube.T
    bump = 0.06 * np.sin(np.pi * x) * np.sin(np.pi * y) * np.sin(np.pi * z)
    return np.column_stack([x + bump, y - bump, z + bump])


def all_walls(points: Points) -> BoolArray:
    on = (points[:, 2] == 1.0) | (np.abs(points[:, :2] - 0.5) == 0.5).any(axis=1)
    return np.repeat(on[:, None], 3, axis=1)


def errors(element: Element, nu: float, cells: int) -> FloatArray:
    """L2 errors of displacement, its gradient and, in mixed elements, the pressure."""
    mesh = mapped((cells, cells, cells), skewed, 1.0)
    space = supported(mesh, element, all_walls)
    material = uniform(len(mesh.tets), nu, YEOH)
    incompressible = nu == 0.5

    def exact(points: Points) -> Exact:
        fields = bent(points, 0.0 if incompressible else 0.15)
        return fields if incompressible else Exact(fields.u, fields.F, lame_modulus(nu) * (np.linalg.det(fields.F) - 1))

    rule = integrals(space, 2 + element.order)
    truth = exact(rule.positions)
    load = rule.forces(piola(truth.F, truth.p, nu, YEOH))
    at_nodes = exact(space.points)
    guess = Unknowns(at_nodes.u, np.zeros(space.pressures if material.mixed else 0))
    body, state, _ = equilibrium(space, material, at_nodes.u, load, guess=guess)
    found = [rule.norm(rule.values(state.u) - truth.u), rule.norm(rule.deformation(state.u) - truth.F)]
    if body.mixed:
        found.append(rule.norm(rule.pressure(material, state.u, state.p) - truth.p))
    return np.array(found)


@pytest.mark.parametrize("nu", [0.2, 0.4, 0.5])
@pytest.mark.parametrize("element", [p1p1, p2p1])
def test_errors_fall_at_the_rate_of_theory(element: Callable[[], Element], nu: float) -> None:
    """Displacement-only at 0.2, compressible mixed at 0.4, exactly incompressible at 0.5; Yeoh's law."""
    made = element()
    degree = made.order
    coarse, fine = (4, 8) if degree == 1 else (3, 6)
    rates = np.log2(errors(made, nu, coarse) / errors(made, nu, fine))
    # At these sizes the next power of h adds a few percent to the errors, so 0.1 to 0.15 to their rates.
    assert rates[0] == pytest.approx(degree + 1, abs=0.15)
    assert rates[1] == pytest.approx(degree, abs=0.1)
    if nu >= 0.3:
        assert 1.4 < rates[2] < 2.1 if degree == 1 else 1.8 < rates[2] < 2.4
