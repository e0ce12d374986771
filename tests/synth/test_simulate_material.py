"""Materials: layers with the jump of pressure between them, exact incompressibility, and the barrier against folds."""

import numpy as np
import pytest
from integrals import Integrals
from pads import ELEMENT, MIXED, brick, complete, crooked, dense, equilibrium, far_away, layered, scene, supported
from scipy.optimize import brentq

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import Focus
from synth.mesh.element import p2p1
from synth.press.resolution import graded_mesh
from synth.scene import Gel
from synth.simulate.inversion_barrier import ONSET, SAMPLE_DEGREE
from synth.simulate.material import lame_constants, pad_material, uniform
from synth.simulate.space import function_space
from synth.simulate.system import System, Unknowns

SIZE = (3.0, 2.0, 3.0)
INTERFACE = 1.0
each = pytest.mark.parametrize("element", MIXED)


def gel(**parts: object) -> Gel:
    return scene(SIZE, gel=parts).sensor.gel


FILM = {"thickness_mm": INTERFACE, "youngs_modulus_kpa": 200e3, "poisson_ratio": 0.3, "stiffening": (0.5, 0.1)}


def test_layers_are_relative_to_the_gel() -> None:
    mesh = layered(brick(SIZE, (2, 2, 3)))
    made = pad_material(gel(layers=[FILM], poisson_ratio=0.5, stiffening=(0.2, 0.0)), mesh)
    film = mesh.layer == 0
    mu, lame = lame_constants(0.3)
    np.testing.assert_allclose(made.shear[film], 1000 * mu, rtol=1e-12)
    np.testing.assert_allclose(made.lame[film], 1000 * lame, rtol=1e-12)
    assert (made.yeoh[film] == (0.5, 0.1)).all()
    np.testing.assert_allclose(made.shear[~film], 1 / 3, rtol=1e-12)
    assert (made.lame[~film] == np.inf).all()
    assert (made.yeoh[~film] == (0.2, 0.0)).all()
    assert made.mixed


def confined(points: Points) -> BoolArray:
    """Glued at the window, pushed by a plate at z = 0, smooth walls around."""
    held = np.zeros(points.shape, dtype=bool)
    held[:, 0] = np.abs(points[:, 0]) == SIZE[0] / 2
    held[:, 1] = np.abs(points[:, 1]) == SIZE[1] / 2
    held[:, 2] = (points[:, 2] == 0) | (points[:, 2] == SIZE[2])
    held[points[:, 2] == SIZE[2]] = True
    return held


def oedometer_stress(stretch: float, nu: float, modulus: float) -> float:
    """P_zz of a confined neo-Hookean body."""
    mu, lame = lame_constants(nu)
    return float(modulus * (mu * (stretch - 1 / stretch) + lame * (stretch - 1)))


@each
def test_layers_in_series_share_the_stress_and_not_the_pressure(element: str) -> None:
    """Confined compression of two layers, moduli 1 : 1000: each strains uniformly; the pressure jumps between them."""
    push, soft, hard = 0.3, 0.4, 0.3
    mesh = layered(brick(SIZE, (2, 2, 3)))
    gel_ = gel(poisson_ratio=soft, layers=[{**FILM, "stiffening": (0, 0)}])
    below = SIZE[2] - INTERFACE

    def stretches(gel_stretch: float) -> tuple[float, float]:
        return gel_stretch, (SIZE[2] - push - gel_stretch * below) / INTERFACE

    def mismatch(gel_stretch: float) -> float:
        in_gel, in_film = stretches(gel_stretch)
        return oedometer_stress(in_gel, soft, 1) - oedometer_stress(in_film, hard, 1000)

    in_gel, in_film = stretches(float(brentq(mismatch, 0.8, 0.9, xtol=1e-15)))
    space = supported(mesh, ELEMENT[element](), confined)
    moved = np.zeros_like(space.points)
    z = space.points[:, 2]
    moved[:, 2] = np.where(z > INTERFACE, (1 - in_gel) * (SIZE[2] - z), push + (in_film - 1) * z)
    _, state, force = equilibrium(space, pad_material(gel_, mesh), moved, steps=3)
    # Newton stops at 1e-10 of the forces; a contrast of 1000 may enlarge that in the soft layer's displacement.
    np.testing.assert_allclose(state.u, moved, atol=1e-7)
    for layer, stretch, nu, modulus in ((0, in_film, hard, 1000), (1, in_gel, soft, 1)):
        own = np.unique(space.pressure_nodes[mesh.layer == layer])
        pressure = modulus * lame_constants(nu)[1] * (stretch - 1)
        np.testing.assert_allclose(state.p[own], pressure, rtol=1e-6)
    pushing = force[space.points[:, 2] == 0, 2].sum()
    assert pushing == pytest.approx(-oedometer_stress(in_gel, soft, 1) * SIZE[0] * SIZE[1], rel=1e-7)


@each
def test_two_layers_of_one_material_are_one_but_for_the_pressure(element: str) -> None:
    """Where the pressure is the same on both sides of the interface, so are all forces."""
    plain = brick(SIZE, (2, 2, 3))
    one, two = (function_space(mesh, ELEMENT[element]()) for mesh in (plain, layered(plain)))
    bodies = [System(space, uniform(len(plain.tets), 0.4999)) for space in (one, two)]
    rng = np.random.default_rng(1)
    state = bodies[0].zero()
    state = Unknowns(0.03 * rng.standard_normal(state.u.shape), rng.standard_normal(state.p.shape))
    shared = np.zeros(two.pressures, dtype=int)
    shared[two.pressure_nodes] = one.pressure_nodes
    a = bodies[0].residual(state, far_away())
    b = bodies[1].residual(Unknowns(state.u, state.p[shared]), far_away())
    scale = 1e-12 * np.abs(a.nodal_forces).max()  # sums of some dozen rounded element forces, in another order
    np.testing.assert_allclose(b.nodal_forces, a.nodal_forces, atol=scale)
    volume: FloatArray = np.zeros(one.pressures)
    np.add.at(volume, shared, b.free[-two.pressures :])
    np.testing.assert_allclose(volume, a.free[-one.pressures :], atol=scale)


@each
def test_exactly_incompressible_is_the_limit(element: str) -> None:
    mesh = brick(SIZE, (4, 4, 3))
    ball, numerics, forces = {"shape": "sphere", "radius_mm": 2.0}, {"element": element}, []
    for nu in (0.49, 0.4999, 0.499999, 0.5):
        posed = scene(SIZE, gel={"poisson_ratio": nu}, indenter=ball, numerics=numerics)
        forces.append(complete(posed, mesh).states[-1].force_n[2])
    gaps = [abs(force / forces[-1] - 1) for force in forces[:-1]]
    # 1 - 2 nu falls by 100 each time, and the force's distance from the limit with it.
    assert gaps[0] > 20 * gaps[1] > 400 * gaps[2] > 0
    assert gaps[2] < 1e-4


MESH = crooked()
CORNERS = np.array([n for n in np.ndindex(*4 * [SAMPLE_DEGREE + 1]) if sum(n) == SAMPLE_DEGREE]) / SAMPLE_DEGREE
"""(20, 4) barycentric coordinates of the points at which folds are looked for."""


def guarded_pad(guarded: bool = True) -> System:
    body = System(function_space(MESH, p2p1()), uniform(len(MESH.tets), 0.5))
    if not guarded:
        body._barrier = None
    return body


def squeezed(body: System, size: float) -> Unknowns:
    """Random displacements, so large that det F comes near 0 at some points."""
    rng = np.random.default_rng(3)
    zero = body.zero()
    return Unknowns(size * rng.standard_normal(zero.u.shape), 0.1 * rng.standard_normal(zero.p.shape))


def sampled_jacobian(body: System, u: FloatArray) -> tuple[FloatArray, Integrals]:
    """(m, p) det F at the sample points, by shape functions of their own."""
    points = Integrals(body.space, CORNERS, np.full(len(CORNERS), 1 / len(CORNERS)))
    return np.linalg.det(points.deformation(u)), points


def barrier(body: System, u: FloatArray) -> float:
    """The energy of `synth.simulate.inversion_barrier`; mu = E / 3 at a Poisson ratio of 0.5."""
    jacobian, points = sampled_jacobian(body, u)
    return float((points.volume * np.log(np.maximum(ONSET / jacobian, 1.0)) ** 3).sum() / 9)


@pytest.fixture(scope="module")
def state() -> Unknowns:
    body = guarded_pad()
    sizes = np.linspace(0.03, 0.2, 35)
    valid = [size for size in sizes if sampled_jacobian(body, squeezed(body, size).u)[0].min() > 0.05]
    found = squeezed(body, valid[-1])
    assert (sampled_jacobian(body, found.u)[0] < ONSET).sum() > 5
    return found


def forces(body: System, state: Unknowns) -> FloatArray:
    return body.residual(state, far_away()).nodal_forces.copy()


def test_forces_are_the_energys_gradient_tangent_their_derivative_and_corners_are_seen(state: Unknowns) -> None:
    body, bare = guarded_pad(), guarded_pad(guarded=False)
    found = forces(body, state) - forces(bare, state)
    rng = np.random.default_rng(0)
    for _ in range(4):
        way = rng.standard_normal(state.u.shape)
        h = 1e-6
        slope = (barrier(body, state.u + h * way) - barrier(body, state.u - h * way)) / (2 * h)
        # Third derivatives of t³ over J near 0.05 are some 1e4: h² of that, and rounding / h of 1e-10.
        assert (found * way).sum() == pytest.approx(slope, rel=1e-6, abs=1e-8)
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
    smallest = body.residual(state, far_away()).smallest_jacobian
    assert smallest <= sampled_jacobian(body, state.u)[0].min() + 1e-12


def test_not_a_bit_is_added_where_nothing_folds() -> None:
    body, bare = guarded_pad(), guarded_pad(guarded=False)
    gentle = squeezed(body, 0.01)
    assert sampled_jacobian(body, gentle.u)[0].min() > ONSET
    np.testing.assert_array_equal(forces(body, gentle), forces(bare, gentle))


def test_no_fold_under_a_tip() -> None:
    """A cone's tip finer than an element folded some over at their corners (det F = -4.2) without the barrier."""
    cone = {"shape": "cone", "half_angle_deg": 20.0, "height_mm": 6.0, "fillet_mm": 0.05}
    posed = scene((12.0, 10.0, 4.0), indenter=cone, motion={"depth_mm": 1.6, "steps": 1}, numerics={"element": "p2p1"})
    mesh, _ = graded_mesh(posed.sensor.gel, Focus((0.0, 0.0), (0.8, 0.8)), 4)
    last = complete(posed, mesh).states[-1]
    body = System(function_space(mesh, p2p1()), uniform(len(mesh.tets), 0.5))
    assert sampled_jacobian(body, last.displacement)[0].min() > 0
    assert last.min_jacobian > 0
