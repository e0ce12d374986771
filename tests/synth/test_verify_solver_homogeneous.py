"""Uniform finite strain against closed forms: uniaxial stretch and simple shear, from Poisson's ratio 0 to 0.5.

The bodies are irregular meshes, supported so that the strain is uniform; linear and quadratic elements both contain the
exact solution, so that only Newton's tolerance (1e-10 of the forces, `problems.TIGHT`) and the conditioning separate
them from it.
"""

from collections.abc import Callable

import numpy as np
import pytest
from closed_forms import NEO_HOOKEAN, YEOH, Stiffening, piola, shear_traction, uniaxial
from layered_pad import layered
from pads import crooked
from problems import equilibrium, face_load, supported

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import PadMesh
from synth.simulate.element import Element, p1p1, p2p1
from synth.simulate.material import Material, uniform
from synth.simulate.space import Space

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
    """Two incompressible layers drawn along their interface: each bears its own stress, and so its own pressure.

    The pressure jumps at the interface, which one that is continuous through the pad could not follow.
    """
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


def test_closed_forms_agree_with_each_other() -> None:
    """The stress of a general strain, the textbook's bar and the shear stress come from different formulas."""
    for nu in RATIOS:
        for stiffening in (NEO_HOOKEAN, YEOH):
            lateral, stress = uniaxial(1.4, nu, stiffening)
            F = np.diag([1.4, lateral, lateral])
            J = np.linalg.det(F)
            free = piola(F, np.zeros(()), nu, stiffening)[1, 1]
            p = -free * lateral / J  # that takes the lateral stress away
            P = piola(F, np.array(p), nu, stiffening)
            np.testing.assert_allclose(P, np.diag([stress, 0.0, 0.0]), atol=1e-9 if nu == 0.4999 else 1e-12)
            tilt = np.eye(3)
            tilt[0, 2] = 0.6
            tau = shear_traction(0.6, nu, stiffening)
            expected = np.zeros((3, 3))
            expected[0, 2] = expected[2, 0] = tau
            np.testing.assert_allclose(piola(tilt, np.zeros(()), nu, stiffening), expected, atol=1e-15)
