"""What must not depend on the axes, and without friction not on the way: whole trajectories of layered pads."""

import numpy as np
import pytest
from layered_pad import FILM, pad
from pads import MIXED, SIZE, SPHERE, scene

from synth.mesh import PadMesh
from synth.scene import Scene
from synth.simulate import Trajectory, simulate

TOLERANCE = 1e-8
GEL = {"poisson_ratio": 0.4999, "stiffening": (0.05, 0.0), "layers": [{**FILM, "poisson_ratio": 0.5}]}
TORUS = {"shape": "torus", "radius_mm": 1.2, "tube_mm": 0.8, "rotation_deg": [8.0, 0.0, 0.0]}


def case(
    element: str, friction: float, motion: dict, size: tuple[float, float, float] = SIZE, **parts: object
) -> Scene:
    numerics = {"element": element, "tolerance": TOLERANCE, "max_step_mm": 0.1, "edge_length_mm": None}
    return scene(size, gel=GEL, friction=friction, motion=motion, numerics=numerics, **parts)


def complete(posed: Scene, mesh: PadMesh) -> Trajectory:
    result = simulate(posed, mesh)
    assert (result.status, result.reason) == ("complete", "")
    return result


@pytest.mark.parametrize("element", MIXED)
def test_turned_pad_and_motion_turn_the_answer(element: str) -> None:
    """Frame indifference: mesh, place, shear and indenter turned by 90 degrees about z turn displacement and forces.

    The elements' kernels see other numbers in other components, and friction other tangents.
    """
    motion = {"depth_mm": 0.6, "shear_mm": [0.4, -0.2], "twist_deg": 15.0, "position_mm": [0.5, 0.3], "steps": 3}
    turned = {**motion, "shear_mm": [0.2, 0.4], "position_mm": [-0.3, 0.5]}
    mesh = pad(layers=True)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    across = (SIZE[1], SIZE[0], SIZE[2])
    other = PadMesh(mesh.points @ turn.T, mesh.tets, across, mesh.layer)
    tilted = {**TORUS, "rotation_deg": [8.0, 0.0, 90.0]}
    one = complete(case(element, 0.4, motion, indenter=TORUS), mesh)
    two = complete(case(element, 0.4, turned, across, indenter=tilted), other)
    np.testing.assert_allclose(two.space.points, one.space.points @ turn.T, atol=1e-14)
    for a, b in zip(one.states[1:], two.states[1:], strict=True):
        # Newton stops at 1e-8 where states are recorded and at 1e-3 between, whose errors friction remembers: they are
        # the same in both but for rounding, unless a point near its limit falls on the other side of it.
        np.testing.assert_allclose(b.displacement, a.displacement @ turn.T, atol=1e-6)
        np.testing.assert_allclose(b.force_n, turn @ a.force_n, atol=1e-6)
        np.testing.assert_allclose(b.torque_nmm, turn @ a.torque_nmm, atol=1e-5)
        assert np.linalg.norm(a.force_n[:2]) > 0.01


@pytest.mark.parametrize("indenter", [SPHERE, TORUS])
@pytest.mark.parametrize("element", MIXED)
def test_end_does_not_remember_the_way_without_friction(element: str, indenter: dict) -> None:
    """Straight down, or deeper elsewhere, across, round and up: the end is the same."""
    end = {"depth_mm": 0.5, "shear_mm": [0.5, 0.2]}
    straight = {"depth_mm": 0.5, "position_mm": [0.4, 0.1], "steps": 1}
    detour = {"depth_mm": 0.9, "position_mm": [-0.1, -0.1], "shear_mm": [-0.3, 0.4], "steps": 3, "then": [end]}
    mesh = pad(layers=True)
    a = complete(case(element, 0.0, straight, indenter=indenter), mesh).states[-1]
    b = complete(case(element, 0.0, detour, indenter=indenter), mesh).states[-1]
    # Both are equilibria to 1e-8 of the nodal forces, of a body whose softest mode takes some 1e2 times its share.
    np.testing.assert_allclose(b.displacement, a.displacement, atol=1e-6)
    np.testing.assert_allclose(b.force_n, a.force_n, atol=1e-6 * a.force_n[2])
    np.testing.assert_allclose(b.torque_nmm, a.torque_nmm, atol=1e-5 * a.force_n[2])
