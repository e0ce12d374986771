"""Materials: constants, layers with the jump of pressure between them, and exact incompressibility."""

import numpy as np
import pytest
from layered_pad import layered
from pads import ELEMENT, MIXED, brick, far_away, scene
from problems import equilibrium, supported
from scipy.optimize import brentq

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import PadMesh
from synth.scene import Gel
from synth.simulate import State, simulate
from synth.simulate.material import lame_constants, pad_material, uniform
from synth.simulate.space import function_space
from synth.simulate.system import System, Unknowns

SIZE = (3.0, 2.0, 3.0)
INTERFACE = 1.0
each = pytest.mark.parametrize("element", MIXED)


def gel(**parts: object) -> Gel:
    return scene(SIZE, gel=parts).sensor.gel


FILM = {"thickness_mm": INTERFACE, "youngs_modulus_kpa": 200e3, "poisson_ratio": 0.3, "stiffening": (0.5, 0.1)}


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.4999])
def test_lame_constants_give_back_youngs_modulus(nu: float) -> None:
    mu, lame = lame_constants(nu)
    assert mu * (3 * lame + 2 * mu) / (lame + mu) == pytest.approx(1, rel=1e-12)
    assert lame / (2 * (lame + mu)) == pytest.approx(nu, abs=1e-12)


def test_incompressible_gel_has_no_finite_lame_constant() -> None:
    assert lame_constants(0.5) == (pytest.approx(1 / 3), np.inf)


def test_layers_are_relative_to_the_gel() -> None:
    mesh = layered(brick(SIZE, (2, 2, 3)))
    made = pad_material(gel(layers=[FILM], poisson_ratio=0.5, stiffening=(0.2, 0.0)), mesh)
    film = mesh.layer == 0
    mu, lame = lame_constants(0.3)
    np.testing.assert_allclose(made.shear[film], 1000 * mu, rtol=1e-12)
    np.testing.assert_allclose(made.lame[film], 1000 * lame, rtol=1e-12)
    assert (made.yeoh[film] == (0.5, 0.1)).all()
    assert (made.shear[~film] == lame_constants(0.5)[0]).all()
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
    scale = 1e-12 * np.abs(a.reaction).max()  # sums of some dozen rounded element forces, in another order
    np.testing.assert_allclose(b.reaction, a.reaction, atol=scale)
    volume: FloatArray = np.zeros(one.pressures)
    np.add.at(volume, shared, b.free[-two.pressures :])
    np.testing.assert_allclose(volume, a.free[-one.pressures :], atol=scale)


def press(element: str, mesh: PadMesh, **gel_: object) -> State:
    ball, numerics = {"shape": "sphere", "radius_mm": 2.0}, {"element": element}
    result = simulate(scene(SIZE, gel=gel_, indenter=ball, numerics=numerics), mesh)
    assert (result.status, result.reason) == ("complete", "")
    return result.states[-1]


@each
def test_stiff_film_spreads_the_press(element: str) -> None:
    mesh = brick(SIZE, (4, 4, 3))
    soft, film = press(element, mesh), press(element, layered(mesh), layers=[FILM])
    assert film.force_n[2] > 3 * soft.force_n[2]
    edge = np.abs(mesh.points[:, :2]).max(axis=1) == SIZE[0] / 2
    rim = np.flatnonzero(edge & (mesh.points[:, 2] == 0))
    assert film.displacement[rim, 2].max() > 2 * abs(soft.displacement[rim, 2]).max()


@each
def test_exactly_incompressible_is_the_limit(element: str) -> None:
    mesh = brick(SIZE, (4, 4, 3))
    forces = [press(element, mesh, poisson_ratio=nu).force_n[2] for nu in (0.49, 0.4999, 0.499999, 0.5)]
    gaps = [abs(force / forces[-1] - 1) for force in forces[:-1]]
    # 1 - 2 nu falls by 100 each time, and the force's distance from the limit with it.
    assert gaps[0] > 20 * gaps[1] > 400 * gaps[2] > 0
    assert gaps[2] < 1e-4
