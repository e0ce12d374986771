"""The gel without contact: energy, gradient and Hessian of each element and law, invariances, patch test."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from closed_forms import lame_modulus, piola
from integrals import Integrals
from pads import ELEMENT, MIXED, crooked, dense, far_away, found_by_newton

from synth.arrays import FloatArray
from synth.simulate.material import Material, uniform
from synth.simulate.pattern import pattern_of
from synth.simulate.space import Space, function_space
from synth.simulate.system import System, Unknowns
from synth.simulate.tables import laplace_table

MESH = crooked()
UNHELD = replace(MESH, size_mm=(*MESH.size_mm[:2], 99.0))
"""The same mesh with no node where the window would be: nothing is held."""
GRADIENT = np.array([[0.06, 0.10, -0.04], [-0.03, 0.05, 0.08], [0.02, -0.06, -0.09]])  # Of an affine displacement
LAWS = {"hooke": (0.0, 0.0), "yeoh": (0.7, 0.4), "yeoh, c3 alone": (0.0, 0.4), "yeoh, c2 alone": (0.7, 0.0)}


@dataclass(frozen=True)
class Case:
    """An element with a law; the law "motley" changes from element to element, and so does the stiffness."""

    element: str
    nu: float
    law: str = "hooke"

    def __str__(self) -> str:
        return f"{self.element}-{self.nu}-{self.law}"

    def material(self) -> Material:
        count = len(MESH.tets)
        if self.law != "motley":
            return uniform(count, self.nu, LAWS[self.law])
        share = np.random.default_rng(1).uniform(1.0, 3.0, count)
        even = uniform(count, self.nu)
        laws = np.array(list(LAWS.values()))[np.arange(count) % 4]
        return replace(even, shear=share * even.shear, lame=share * even.lame, yeoh=laws)

    def body(self, held: bool = True) -> System:
        space = function_space(MESH if held else UNHELD, ELEMENT[self.element]())
        body = System(space, self.material())
        body._barrier = None  # the barrier has a test of its own
        return body


CASES = [Case(e, nu) for e in MIXED for nu in (0.0, 0.2, 0.3, 0.45, 0.4999, 0.5)]
CASES += [Case("p1", 0.45), Case("p1p1", 0.45, "yeoh"), Case("p2p1", 0.2, "yeoh"), Case("p2p1", 0.5, "yeoh")]
MOTLEY = [Case(e, nu, "motley") for e in MIXED for nu in (0.2, 0.45, 0.5) if (e, nu) != ("p1p1", 0.5)]
FEW = [Case("p1p1", 0.2), Case("p1p1", 0.4999), Case("p2p1", 0.4999, "yeoh")]
each = pytest.mark.parametrize("case", CASES + MOTLEY, ids=str)
few = pytest.mark.parametrize("case", FEW, ids=str)


def random_state(body: System, rng: np.random.Generator, size: float = 0.03) -> Unknowns:
    """Displacements and pressures at all nodes that leave every det F positive."""
    zero = body.zero()
    return Unknowns(size * rng.standard_normal(zero.u.shape), rng.standard_normal(zero.p.shape))


def residual(body: System, state: Unknowns) -> FloatArray:
    """All rows, held ones too: 3 n forces, then the volume equations where there is a pressure field."""
    found = body.residual(state, far_away())
    assert found.smallest_jacobian > 0
    full = np.zeros(state.u.size + state.p.size)
    full[body.free] = found.free
    full[: state.u.size] = found.nodal_forces.ravel()
    return full


def stacked(state: Unknowns) -> FloatArray:
    return np.concatenate([state.u.ravel(), state.p.ravel()])


def quadrature(space: Space) -> Integrals:
    """Points of equal weight: the centre, or four, exact for products of linear gradients (Hammer et al., 1956)."""
    points = np.full((4, 4), (1 - 1 / np.sqrt(5)) / 4) + np.eye(4) / np.sqrt(5)
    if space.element.order == 1:
        points = np.full((1, 4), 0.25)
    return Integrals(space, points, np.full(len(points), 1 / len(points)))


@each
def test_residual_is_the_gradient_of_the_energy(case: Case) -> None:
    rng = np.random.default_rng(1)
    body = case.body()
    state, direction = random_state(body, rng), random_state(body, rng, 1.0)
    rule, material = quadrature(body.space), replace(case.material(), mixed=body.mixed)
    h = 1e-5
    ends = [state.plus(direction, step) for step in (h, -h)]
    ahead, behind = (rule.energy(material, end.u, end.p) for end in ends)
    # Central difference: error h^2 times the third derivative, about 1e-10 * 1e3, over an energy slope of about 10.
    assert residual(body, state) @ stacked(direction) == pytest.approx((ahead - behind) / (2 * h), rel=1e-6)


@each
def test_tangent_is_the_derivative_of_the_residual(case: Case) -> None:
    rng = np.random.default_rng(2)
    body = case.body()
    state = random_state(body, rng)
    tangent = body.tangent(state, far_away())
    assert tangent.remainder is None
    matrix = dense(body, tangent)
    h = 1e-5
    for _ in range(3):
        direction = random_state(body, rng, 1.0)
        direction.u[body.space.held] = 0.0
        ahead = residual(body, state.plus(direction, h))
        behind = residual(body, state.plus(direction, -h))
        difference = ((ahead - behind) / (2 * h))[body.free]
        # As above: h^2 times third derivatives over first ones, some 1e-10 * 1e3.
        error = np.linalg.norm(matrix @ stacked(direction)[body.free] - difference)
        assert error < 1e-6 * np.linalg.norm(difference)


@pytest.mark.parametrize("nu", [0.3, 0.45])
def test_residual_has_no_jump_where_the_hold_of_dilation_bends(nu: float) -> None:
    body = Case("p2p1", nu).body()
    state = random_state(body, np.random.default_rng(3))
    for share in (0.25, 0.5, 0.75):  # of λ: C |p|, with C = 2
        ends = [np.full_like(state.p, -(share + h) * lame_modulus(nu) / 2) for h in (-1e-8, 1e-8)]
        before, after = (residual(body, Unknowns(state.u, p)) for p in ends)
        assert np.linalg.norm(after - before) < 1e-6 * np.linalg.norm(before)


def turn(rng: np.random.Generator) -> FloatArray:
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return np.asarray(q * np.sign(np.linalg.det(q)))


@few
def test_rigid_motion_is_free_of_stress_and_inner_forces_turn_with_the_body_and_cancel(case: Case) -> None:
    rng = np.random.default_rng(4)
    body = case.body()
    for _ in range(3):
        u = body.space.points @ (turn(rng) - np.eye(3)).T + rng.standard_normal(3)
        # A dozen products of numbers of order 1, times a bulk modulus of 1e3 that sees det F - 1 = 1e-16.
        assert np.abs(residual(body, Unknowns(u, body.zero().p))).max() < 1e-12
    # Frame indifference: x -> Q x + c turns the forces by Q and leaves the volume equations alone.
    rng = np.random.default_rng(5)
    state, Q, rest = random_state(body, rng), turn(rng), body.space.points
    turned = (rest + state.u) @ Q.T + rng.standard_normal(3) - rest
    before, after = residual(body, state), residual(body, Unknowns(turned, state.p))
    n = state.u.size
    scale = 1e-12 * np.abs(before).max()  # rounding as above
    np.testing.assert_allclose(after[:n].reshape(-1, 3), before[:n].reshape(-1, 3) @ Q.T, atol=scale)
    np.testing.assert_allclose(after[n:], before[n:], atol=scale)
    state = random_state(body, np.random.default_rng(6))
    force = residual(body, state)[: state.u.size].reshape(-1, 3)
    scale = 1e-13 * np.abs(force).sum()  # a sum of some hundred rounded forces
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=scale)
    np.testing.assert_allclose(np.cross(body.space.points + state.u, force).sum(axis=0), 0.0, atol=2 * scale)


@pytest.mark.parametrize("case", [case for case in CASES if case.nu < 0.5], ids=str)  # at 0.5 the pressure is free
def test_patch_and_stress_of_a_uniform_strain(case: Case) -> None:
    """Affine displacement on the boundary of an irregular mesh: affine inside, with the exact constant pressure."""
    body = case.body(held=False)
    rest = body.space.points
    exact = rest @ GRADIENT.T
    inside = ((rest > rest.min(axis=0)) & (rest < rest.max(axis=0))).all(axis=1)
    assert inside.any()
    state = body.zero()
    assert len(body.free) == state.u.size + state.p.size
    state.u[:] = exact + 0.02 * inside[:, None] * np.random.default_rng(7).standard_normal(exact.shape)
    unknown = np.flatnonzero(np.concatenate([np.repeat(inside, 3), np.ones(state.p.size, dtype=bool)]))
    for _ in range(12):
        found = body.residual(state, far_away())
        matrix = dense(body, body.tangent(state, far_away()))
        step = np.zeros(len(body.free))
        step[unknown] = -np.linalg.solve(matrix[np.ix_(unknown, unknown)], found.free[unknown])
        state.u[:] += step[: state.u.size].reshape(-1, 3)
        state.p[:] += step[state.u.size :]
    # Newton ends at rounding: 1e-16 times a condition number of some 1e5 (bulk over shear modulus, and the mesh).
    np.testing.assert_allclose(state.u, exact, atol=1e-11)
    np.testing.assert_allclose(state.p, lame_modulus(case.nu) * (np.linalg.det(np.eye(3) + GRADIENT) - 1), rtol=1e-9)
    # Nodal forces do the work of the closed form's stress P = 2 W' (F - F^-T) + lambda J (J - 1) F^-T.
    F = np.eye(3) + GRADIENT
    p = lame_modulus(case.nu) * (np.linalg.det(F) - 1)
    full = residual(body, Unknowns(rest @ GRADIENT.T, np.full_like(body.zero().p, p)))
    stress = piola(F, np.array(p), case.nu, LAWS[case.law])
    work = full[: rest.size].reshape(-1, 3).T @ rest  # one virtual affine displacement per component
    # Rounding of a bulk modulus of up to 2e3 times some 1e-15 of relative volume change.
    np.testing.assert_allclose(work / UNHELD.volumes.sum(), stress, atol=1e-11)
    np.testing.assert_allclose(full[rest.size :], 0.0, atol=1e-14 * max(1.0, abs(p)))


@few
def test_inverted_element_is_noticed(case: Case) -> None:
    body = case.body()
    state = body.zero()
    state.u[int(np.flatnonzero(~body.space.held[:, 0])[0])] = MESH.size_mm
    assert body.residual(state, far_away()).smallest_jacobian < 0
    outcome = found_by_newton(body, state, far_away(), 1e-6)
    assert not outcome.converged


@pytest.mark.parametrize("element", MIXED)
def test_laplace_table_is_the_integral(element: str) -> None:
    material = Case(element, 0.45, "motley").material()
    space = function_space(MESH, ELEMENT[element]())
    pairs, rule = pattern_of(space, True).element_pairs, quadrature(space)
    table = laplace_table(space, material, pairs).numpy()
    whole = np.einsum("e,eq,eqac,eqbc->eab", material.shear, rule.volume, rule.gradient, rule.gradient)
    # Sums of some dozen products, and an inverse of a matrix of condition 10 to 100.
    np.testing.assert_allclose(table, whole[:, pairs[:, 0], pairs[:, 1]], rtol=0, atol=1e-13 * np.abs(whole).max())


@pytest.mark.parametrize("element", MIXED)
def test_the_viscous_force_is_what_viscosity_adds_to_the_tangent(element: str) -> None:
    body, rng = Case(element, 0.45).body(), np.random.default_rng(3)
    before, step = random_state(body, rng), random_state(body, rng)
    step.u[body.space.held] = 0.0
    thick, thin = (dense(body, body.tangent(before, far_away(), viscosity)) for viscosity in (0.7, 0.0))
    expected = (thick - thin) @ np.concatenate([step.u.ravel(), step.p])[body.free]
    found = body.viscous_force(before, before.plus(step, 1.0), 0.7)
    # Sums of some hundred terms; the difference of two tangents leaves 1e-16 of their entries, of size 1 to 100.
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max() + 1e-13)
    assert np.abs(found).max() > 1e-3
