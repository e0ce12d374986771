r"""Convergence rates of the elements on a manufactured finite strain with a closed form.

A unit cube, held as the exact solution says on all faces but z = 0, is bent by a smooth deformation. Its dead nodal
loads are ∫ P ∇N_a of the exact stress, by a rule of degree 5 or more: body force and surface traction at once, whose
equations the exact solution satisfies with any test function. (With more faces free the dead loads make it buckle.)
Interpolation theory then gives errors of order h^(k+1) in displacement and h^k in its gradient for elements of degree
k, and h² in the pressure of P2/P1 (Boffi, Brezzi & Fortin, Mixed Finite Element Methods, 2013, sec. 8.8); P1/P1's
pressure is of order 1.5 or better on smooth meshes (at least 1: Dohrmann & Bochev 2004).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from closed_forms import YEOH, lame_modulus, piola
from integrals import integrals
from problems import equilibrium, mapped, supported

from synth.arrays import BoolArray, FloatArray, Points
from synth.simulate.element import Element, p1p1, p2p1
from synth.simulate.material import uniform
from synth.simulate.system import Unknowns


@dataclass(frozen=True)
class Exact:
    """Manufactured fields at undeformed points (..., 3): displacement, F, and pressure."""

    u: FloatArray
    F: FloatArray
    p: FloatArray


def gradient(points: Points, entries: dict[tuple[int, int], FloatArray]) -> FloatArray:
    """(..., 3, 3) identity with some entries replaced."""
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


def walls(points: Points) -> BoolArray:
    """All faces of the cube but z = 0."""
    on = (points[:, 2] == 1.0) | (np.abs(points[:, :2] - 0.5) == 0.5).any(axis=1)
    return np.repeat(on[:, None], 3, axis=1)


def errors(element: Element, nu: float, cells: int) -> FloatArray:
    """L2 errors of displacement, its gradient and, in mixed elements, the pressure."""
    mesh = mapped((cells, cells, cells), skewed, 1.0)
    space = supported(mesh, element, walls)
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
