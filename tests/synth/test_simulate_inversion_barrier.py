"""The barrier against folded P2 elements: gradient and Hessian, nothing where nothing folds, no fold under an edge."""

from itertools import product

import numpy as np
import pytest
from integrals import Integrals
from pads import crooked, dense, far_away, scene

from synth.arrays import FloatArray
from synth.mesh import Focus
from synth.simulate import simulate
from synth.simulate.element import p2p1
from synth.simulate.inversion_barrier import ONSET, SAMPLE_DEGREE
from synth.simulate.material import uniform
from synth.simulate.resolution import graded_mesh
from synth.simulate.space import function_space
from synth.simulate.system import System, Unknowns

MESH = crooked()
_STEPS = [steps for steps in product(range(SAMPLE_DEGREE + 1), repeat=4) if sum(steps) == SAMPLE_DEGREE]
CORNERS = np.array(_STEPS) / SAMPLE_DEGREE
"""(20, 4) barycentric coordinates of the points at which folds are looked for."""


def pad(guarded: bool = True) -> System:
    """Incompressible P2/P1, with or without the barrier."""
    body = System(function_space(MESH, p2p1()), uniform(len(MESH.tets), 0.5))
    if not guarded:
        body._barrier = None
    return body


def squeezed(body: System, size: float) -> Unknowns:
    """Random displacements, so large that det F comes near 0 at some points."""
    rng = np.random.default_rng(3)
    zero = body.zero()
    return Unknowns(size * rng.standard_normal(zero.u.shape), 0.1 * rng.standard_normal(zero.p.shape))


def lattice_jacobian(body: System, u: FloatArray) -> tuple[FloatArray, Integrals]:
    """(m, p) det F at the lattice's points, by shape functions of their own."""
    points = Integrals(body.space, CORNERS, np.full(len(CORNERS), 1 / len(CORNERS)))
    return np.linalg.det(points.deformation(u)), points


def barrier(body: System, u: FloatArray) -> float:
    """The energy of `synth.simulate.inversion_barrier`; mu = E / 3 at a Poisson ratio of 0.5."""
    jacobian, points = lattice_jacobian(body, u)
    return float((points.volume * np.log(np.maximum(ONSET / jacobian, 1.0)) ** 3).sum() / 9)


@pytest.fixture(scope="module")
def state() -> Unknowns:
    """A valid state in which some points are below the onset."""
    body = pad()
    sizes = np.linspace(0.03, 0.2, 35)
    valid = [size for size in sizes if lattice_jacobian(body, squeezed(body, size).u)[0].min() > 0.05]
    found = squeezed(body, valid[-1])
    assert (lattice_jacobian(body, found.u)[0] < ONSET).sum() > 5
    return found


def forces(body: System, state: Unknowns) -> FloatArray:
    return body.residual(state, far_away()).reaction.copy()


def test_forces_are_the_energys_gradient(state: Unknowns) -> None:
    body, bare = pad(), pad(guarded=False)
    found = forces(body, state) - forces(bare, state)
    rng = np.random.default_rng(0)
    for _ in range(4):
        way = rng.standard_normal(state.u.shape)
        h = 1e-6
        slope = (barrier(body, state.u + h * way) - barrier(body, state.u - h * way)) / (2 * h)
        # Third derivatives of t³ over J near 0.05 are some 1e4: h² of that, and rounding / h of 1e-10.
        assert (found * way).sum() == pytest.approx(slope, rel=1e-6, abs=1e-8)


def test_tangent_is_the_forces_derivative(state: Unknowns) -> None:
    body = pad()
    tangent = body.tangent(state, far_away())
    full = np.zeros(state.u.size + state.p.size)
    full[body.free] = np.random.default_rng(1).standard_normal(len(body.free))
    moves = state.u.size
    way = Unknowns(full[:moves].reshape(state.u.shape), full[moves:])
    h = 1e-6
    ends = [body.residual(state.plus(way, k * h), far_away()).free for k in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * h)
    found = dense(body, tangent) @ full[body.free]
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_nothing_is_added_where_nothing_folds() -> None:
    """To the bit."""
    body, bare = pad(), pad(guarded=False)
    gentle = squeezed(body, 0.01)
    assert lattice_jacobian(body, gentle.u)[0].min() > ONSET
    np.testing.assert_array_equal(forces(body, gentle), forces(bare, gentle))


def test_smallest_jacobian_looks_at_the_corners(state: Unknowns) -> None:
    body = pad()
    smallest = body.residual(state, far_away()).smallest_jacobian
    assert smallest <= lattice_jacobian(body, state.u)[0].min() + 1e-12


def test_no_fold_under_a_tip() -> None:
    """A cone's tip finer than an element folded some over at their corners (det F = -4.2) without the barrier."""
    cone = {"shape": "cone", "half_angle_deg": 20.0, "height_mm": 6.0, "fillet_mm": 0.05}
    posed = scene((12.0, 10.0, 4.0), indenter=cone, motion={"depth_mm": 1.6, "steps": 1}, numerics={"element": "p2p1"})
    mesh, _ = graded_mesh(posed.sensor.gel, Focus((0.0, 0.0), (0.8, 0.8)), 4)
    pressed = simulate(posed, mesh)
    assert pressed.status == "complete"
    body = System(function_space(mesh, p2p1()), uniform(len(mesh.tets), 0.5))
    assert lattice_jacobian(body, pressed.states[-1].displacement)[0].min() > 0
    assert pressed.states[-1].min_jacobian > 0
