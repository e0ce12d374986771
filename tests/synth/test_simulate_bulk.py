"""The gel without contact: energy, gradient and Hessian, invariances, patch test.

Each comment "fails with" names a change of `synth.simulate.bulk` or `synth.simulate.system` that was tried.
"""

from dataclasses import replace

import numpy as np
import pytest
from pads import crooked, everything, far_away, indenters, scene, system

from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.simulate.newton import solve
from synth.simulate.system import System, Unknowns

MESH = crooked()
LOOSE = replace(MESH, size_mm=(*MESH.size_mm[:2], 99.0))
"""The same mesh with no node where the window would be: nothing is held."""
MIXED, FOAM = 0.4999, 0.2
RATIOS = [0.0, FOAM, 0.3, 0.45, MIXED]
GRADIENT = np.array([[0.06, 0.10, -0.04], [-0.03, 0.05, 0.08], [0.02, -0.06, -0.09]])
"""Of an affine displacement."""


def lame(nu: float) -> float:
    return nu / ((1 + nu) * (1 - 2 * nu))


def random_state(body: System, rng: np.random.Generator, size: float = 0.05) -> Unknowns:
    """Nodal displacements and pressures that leave every det F positive."""
    u = size * rng.standard_normal((1, body.nodes, 3))
    return Unknowns(u, rng.standard_normal((1, body.nodes)) if body.mixed else np.zeros((1, body.nodes)))


def residual(body: System, state: Unknowns) -> FloatArray:
    """All rows, held ones too: 3 n forces, then n volume equations where there is a pressure field."""
    balance = body.balance(state, far_away(), everything(body))
    assert balance.smallest_jacobian[0] > 0
    full = np.zeros(3 * body.nodes + (body.nodes if body.mixed else 0))
    full[body.free] = balance.free[0]
    full[: 3 * body.nodes] = balance.reaction[0].ravel()
    return full


def energy(mesh: PadMesh, nu: float, state: Unknowns, alpha: float = 2.0) -> float:
    """The docstring's functional, term by term, in units of E."""
    mu = 1 / (2 * (1 + nu))
    total = 0.0
    for tet, volume in zip(mesh.tets, mesh.volumes, strict=True):
        rest, now = mesh.points[tet], mesh.points[tet] + state.u[0, tet]
        F = (now[1:] - now[0]).T @ np.linalg.inv((rest[1:] - rest[0]).T)
        J = np.linalg.det(F)
        total += volume * mu / 2 * (np.sum(F * F) - 3 - 2 * np.log(J))
        if nu < 0.3:
            total += volume * lame(nu) / 2 * (J - 1) ** 2
            continue
        p = state.p[0, tet]
        # Integrals of a linear field over a tetrahedron: mean, and mean square (sum p_a^2 + (sum p_a)^2) / 20.
        mean, square = p.mean(), (np.sum(p**2) + p.sum() ** 2) / 20
        total += volume * (mean * (J - 1) - square / (2 * lame(nu)) - alpha / (2 * mu) * (square - mean**2))
    return total


@pytest.mark.parametrize("nu", RATIOS)
def test_residual_is_the_gradient_of_the_energy(nu: float) -> None:
    # Fails with (pJ + mu) for (pJ - mu), without the 1/16 of the stabilisation, with the sign of mass / lame turned.
    rng = np.random.default_rng(1)
    body = system(MESH, nu)
    state, direction = random_state(body, rng), random_state(body, rng, 1.0)
    h = 1e-5
    ahead = energy(MESH, nu, state.plus(direction, np.array([h])))
    behind = energy(MESH, nu, state.plus(direction, np.array([-h])))
    along = np.concatenate([direction.u.ravel(), direction.p.ravel()])[: len(residual(body, state))]
    # Central difference: error h^2 times the third derivative, about 1e-10 * 1e3, over an energy slope of about 10.
    assert residual(body, state) @ along == pytest.approx((ahead - behind) / (2 * h), rel=1e-6)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("nu", RATIOS)
def test_tangent_is_the_derivative_of_the_residual(nu: float, symmetric: bool) -> None:
    # Fails with (pJ - mu) for (mu - pJ), with h_a and h_b exchanged, with J for J * J beside bulk_modulus.
    rng = np.random.default_rng(2)
    body = system(MESH, nu, symmetric)
    state = random_state(body, rng)
    matrix = dense(body, body.tangent(state, far_away(), everything(body))[0])
    h = 1e-5
    for _ in range(3):
        direction = random_state(body, rng, 1.0)
        direction.u[0, MESH.bonded] = 0.0
        ahead = residual(body, state.plus(direction, np.array([h])))
        behind = residual(body, state.plus(direction, np.array([-h])))
        difference = ((ahead - behind) / (2 * h))[body.free]
        along = np.concatenate([direction.u.ravel(), direction.p.ravel()])[body.free]
        # As above: h^2 times third derivatives over first ones, some 1e-10 * 1e3.
        error = np.linalg.norm(matrix @ along - difference)
        assert error < 1e-6 * np.linalg.norm(difference)


def dense(body: System, values: FloatArray) -> FloatArray:
    from scipy.sparse import csr_matrix, triu

    size = len(body.free)
    matrix = csr_matrix((values, body.indices, body.indptr), shape=(size, size))
    if body.symmetric:
        assert (triu(matrix) != matrix).nnz == 0
        matrix = matrix + triu(matrix, k=1).T
    return np.asarray(matrix.todense())


@pytest.mark.parametrize("nu", [FOAM, MIXED])
def test_tangent_is_symmetric_and_its_half_the_same(nu: float) -> None:
    state = random_state(system(MESH, nu), np.random.default_rng(3))
    whole, half = (system(MESH, nu, symmetric) for symmetric in (False, True))
    matrix = dense(whole, whole.tangent(state, far_away(), everything(whole))[0])
    # Sums of up to 30 element entries: rounding of a few 1e-16 of the largest.
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-13 * np.abs(matrix).max())
    other = dense(half, half.tangent(state, far_away(), everything(half))[0])
    np.testing.assert_allclose(matrix, other, atol=1e-13 * np.abs(matrix).max())


def turn(rng: np.random.Generator) -> FloatArray:
    """A proper rotation far from the identity."""
    q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return np.asarray(q * np.sign(np.linalg.det(q)))


@pytest.mark.parametrize("nu", [FOAM, MIXED])
def test_rigid_motion_is_free_of_stress(nu: float) -> None:
    # Fails with F^-1 for its transpose.
    rng = np.random.default_rng(4)
    body = system(MESH, nu)
    for _ in range(3):
        u = MESH.points @ (turn(rng) - np.eye(3)).T + rng.standard_normal(3)
        # A dozen products of numbers of order 1, times a bulk modulus of 1e3 that sees det F - 1 = 1e-16.
        assert np.abs(residual(body, Unknowns(u[None], np.zeros((1, body.nodes))))).max() < 1e-12


@pytest.mark.parametrize("nu", [FOAM, MIXED])
def test_forces_turn_with_the_body(nu: float) -> None:
    """Frame indifference: x -> Q x + c turns the forces by Q and leaves the volume equations alone."""
    rng = np.random.default_rng(5)
    body = system(MESH, nu)
    state, Q = random_state(body, rng), turn(rng)
    turned = (MESH.points + state.u[0]) @ Q.T + rng.standard_normal(3) - MESH.points
    before, after = residual(body, state), residual(body, Unknowns(turned[None], state.p))
    n = 3 * body.nodes
    scale = 1e-12 * np.abs(before).max()  # rounding as above
    np.testing.assert_allclose(after[:n].reshape(-1, 3), before[:n].reshape(-1, 3) @ Q.T, atol=scale)
    np.testing.assert_allclose(after[n:], before[n:], atol=scale)


def test_inner_forces_and_moments_cancel() -> None:
    body = system(MESH, MIXED)
    state = random_state(body, np.random.default_rng(6))
    force = residual(body, state)[: 3 * body.nodes].reshape(-1, 3)
    scale = 1e-13 * np.abs(force).sum()  # a sum of some hundred rounded forces
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=scale)
    np.testing.assert_allclose(np.cross(MESH.points + state.u[0], force).sum(axis=0), 0.0, atol=2 * scale)


@pytest.mark.parametrize("nu", RATIOS)
def test_patch(nu: float) -> None:
    """Affine displacement on the boundary of an irregular mesh: affine inside, with the exact constant pressure.

    Fails without the 1/16 of the stabilisation.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.linalg import spsolve

    body = system(LOOSE, nu, symmetric=False)
    assert len(body.free) == (4 if body.mixed else 3) * body.nodes
    exact = LOOSE.points @ GRADIENT.T
    low, high = LOOSE.points.min(axis=0), LOOSE.points.max(axis=0)
    inside = ((LOOSE.points > low) & (LOOSE.points < high)).all(axis=1)
    assert inside.any()
    unknown = np.flatnonzero(np.concatenate([np.repeat(inside, 3), np.ones(body.nodes * body.mixed, dtype=bool)]))
    start = exact + 0.03 * inside[:, None] * np.random.default_rng(7).standard_normal(exact.shape)
    state = Unknowns(start[None], np.zeros((1, body.nodes)))
    for _ in range(12):
        balance = body.balance(state, far_away(), everything(body))
        values = body.tangent(state, far_away(), everything(body))[0]
        matrix = csr_matrix((values, body.indices, body.indptr))[unknown][:, unknown]
        step = np.zeros(len(body.free))
        step[unknown] = -spsolve(matrix.tocsc(), balance.free[0, unknown])
        state.u[0] += step[: 3 * body.nodes].reshape(-1, 3)
        state.p[0] += step[3 * body.nodes :] if body.mixed else 0.0
    # Newton ends at rounding: 1e-16 times a condition number of some 1e5 (bulk over shear modulus, and the mesh).
    np.testing.assert_allclose(state.u[0], exact, atol=1e-11)
    if body.mixed:
        np.testing.assert_allclose(state.p[0], lame(nu) * (np.linalg.det(np.eye(3) + GRADIENT) - 1), rtol=1e-9)


@pytest.mark.parametrize("nu", RATIOS)
def test_stress_of_a_uniform_strain(nu: float) -> None:
    """Nodal forces do the work of the closed form's stress P = mu (F - F^-T) + lambda J (J - 1) F^-T.

    Fails with 1 - nu for 1 - 2 nu in lambda.
    """
    body = system(LOOSE, nu)
    F = np.eye(3) + GRADIENT
    J, inverse = np.linalg.det(F), np.linalg.inv(F).T
    p = lame(nu) * (J - 1)
    full = residual(body, Unknowns((LOOSE.points @ GRADIENT.T)[None], np.full((1, body.nodes), p)))
    stress = (F - inverse) / (2 * (1 + nu)) + p * J * inverse
    work = full[: 3 * body.nodes].reshape(-1, 3).T @ LOOSE.points  # one virtual affine displacement per component
    # Rounding of a bulk modulus of up to 2e3 times some 1e-15 of relative volume change.
    np.testing.assert_allclose(work / LOOSE.volumes.sum(), stress, atol=1e-11)
    np.testing.assert_allclose(full[3 * body.nodes :], 0.0, atol=1e-14 * max(1.0, abs(p)))


def test_batch_is_what_each_is_alone() -> None:
    rng = np.random.default_rng(8)
    single, triple = system(MESH, MIXED), system(MESH, MIXED, batch=3)
    states = [random_state(single, rng) for _ in range(3)]
    joined = Unknowns(np.concatenate([s.u for s in states]), np.concatenate([s.p for s in states]))
    away = indenters(scene(motion={"depth_mm": -40.0}), 0.0, batch=3)
    active = np.array([True, False, True])
    balance, values = triple.balance(joined, away, active), triple.tangent(joined, away, active)
    for s in (0, 2):
        alone = single.balance(states[s], far_away(), everything(single))
        assert (balance.free[s] == alone.free[0]).all()
        assert balance.smallest_jacobian[s] == alone.smallest_jacobian[0]
        assert (values[s] == single.tangent(states[s], far_away(), everything(single))[0]).all()
    assert not balance.free[1].any()
    assert not values[1].any()


def test_inverted_element_is_noticed() -> None:
    body = system(MESH, MIXED)
    state = body.zero()
    top = int(np.flatnonzero(~MESH.bonded)[0])
    state.u[0, top] = MESH.size_mm
    assert body.balance(state, far_away(), everything(body)).smallest_jacobian[0] < 0
    outcome = solve(body, state, far_away(), everything(body), np.array([1e-6]))
    assert not outcome.converged[0]
