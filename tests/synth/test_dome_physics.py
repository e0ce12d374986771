"""Domed pads in the simulation: the limit of a flat pad, and a plate on a dome against linear layer theory."""

from typing import Any

import numpy as np
import pytest
from bonded_layer import ball
from commands import refused
from pads import brick, complete, simulate_scenes
from pads import scene as pad_scene

from synth.mesh import Focus, domed
from synth.scene import Numerics, Scene
from synth.simulate import Trajectory, simulate
from synth.simulate.resolution import graded_mesh

BALL = {"shape": "sphere", "radius_mm": 3.0}
PLATE = {"shape": "box", "size_mm": (60.0, 60.0, 20.0), "fillet_mm": 0.5}
YOUNG_MPA = 0.2


def scene(
    radius: float | None, size: tuple[float, float, float], indenter: dict[str, Any], friction: float = 0, **motion: Any
) -> Scene:
    gel = {"size_mm": size, "youngs_modulus_kpa": 1e3 * YOUNG_MPA, "poisson_ratio": 0.5, "dome_radius_mm": radius}
    gel["shape"] = "box" if radius is None else "dome"
    numerics = {"element": "auto", "edge_length_mm": None}
    return pad_scene(size, gel=gel, indenter=indenter, friction=friction, motion=motion, numerics=numerics)


def pressed(drawn: Scene, focus: Focus, across: int) -> Trajectory:
    return complete(drawn, graded_mesh(drawn.sensor.gel, focus, across)[0])


def test_a_dome_of_a_kilometre_is_a_flat_pad_but_mesh_and_scene_must_be_of_one() -> None:
    motion, focus = {"position_mm": (0.8, -0.5), "depth_mm": 0.5, "steps": 1}, Focus((0.8, -0.5), (1.0, 1.0))
    drawn = (scene(radius, (10.0, 8.0, 4.0), BALL, **motion) for radius in (None, 1e6))
    flat, dome = (pressed(one, focus, 4).states[-1] for one in drawn)
    # Two balls have the curvature 1/r + 1/R: by Hertz's law the force changes by r / 2R = 1.5e-6; the face at the
    # corners lies 41 mm² / 2R = 2e-5 mm, 5e-6 of the thickness, lower, and a layer's force answers the thickness with
    # an exponent of 2 at most; the place is on a slope of x / R = 1e-6. Newton leaves 1e-6 of the force.
    np.testing.assert_allclose(dome.force_n, flat.force_n, atol=2e-5 * flat.force_n[2])
    # The face itself moved by 2e-5 mm at most; displacements of up to 0.5 mm differ by less than that.
    np.testing.assert_allclose(dome.displacement, flat.displacement, atol=2e-5)
    assert np.abs(flat.displacement).max() > 0.4
    flat, dome = (scene(radius, (10.0, 8.0, 4.0), BALL, depth_mm=0.1) for radius in (None, 20.0))
    mesh = graded_mesh(flat.sensor.gel, Focus((0.0, 0.0), (1.0, 1.0)), 4)[0]
    refused(r"the mesh is of a \([^)]*\) mm pad, the scene's .* of dome radius 20", simulate, dome, mesh)


def test_a_plate_on_a_dome_follows_hertz_and_the_layer() -> None:
    """The linear problem knows only the gap r²/2R between the two: a plate on a dome is a ball on a layer."""
    radius, size = 24.0, (24.0, 24.0, 12.0)
    depths, forces = [0.04, 0.08], []
    contact, _ = ball(depths[-1], radius, size[2])
    for shape, bulge in ((PLATE, radius), ({"shape": "sphere", "radius_mm": radius}, None)):
        drawn = scene(bulge, size, shape, depth_mm=depths[-1], steps=2)
        states = pressed(drawn, Focus((0.0, 0.0), (1.1 * contact, 1.1 * contact)), 4).states[1:]
        assert [state.depth_mm for state in states] == pytest.approx(depths)
        forces.append([state.force_n[2] / YOUNG_MPA for state in states])
    plate, on_flat = np.array(forces)
    theory = np.array([ball(depth, radius, size[2])[1] for depth in depths])
    hertz = 4 / 3 / 0.75 * np.sqrt(radius) * np.array(depths) ** 1.5
    # Elements of a quarter of the contact's width make it up to 2 % stiffer (test_verify_solver_bonded_layer); sides
    # that are free 12 mm away make it softer by up to a third of what the layer adds to Hertz, 12 %.
    np.testing.assert_allclose(plate / theory, 1.0, atol=0.04)
    assert ((plate / hertz > 1) & (plate / hertz < 1.17)).all()
    # Hertz's exponent is 1.5; the layer's is 1.54 here. The mesh is finer for the larger contact: 1.5 % over ln 2.
    assert np.log(plate[1] / plate[0]) / np.log(2) == pytest.approx(1.54, abs=0.04)
    # On the same mesh, but for slopes of a/R = 0.06 and a pad that is thinner by a²/2R = 0.4 % at the contact's rim and
    # by 20 % on average: some 1 %.
    np.testing.assert_allclose(plate / on_flat, 1.0, atol=0.012)


def test_pressed_beside_the_apex_the_plate_meets_the_apex() -> None:
    """A plate has no position: its force is that of the level it is at."""
    radius, size, focus = 24.0, (14.0, 14.0, 6.0), Focus((0.0, 0.0), (3.0, 3.0))
    level = 0.4
    force = []
    for x in (0.0, 4.0):
        rise = radius - np.sqrt(radius**2 - x**2)
        drawn = scene(radius, size, PLATE, position_mm=(x, 0.0), depth_mm=level - rise, steps=1)
        force.append(pressed(drawn, focus, 4).states[-1])
    # Both end at the same level of the same plate, moved along itself without friction: Newton's tolerance of 1e-6,
    # and penetration that the passes leave, below 0.002 of each depth, that is up to 0.3 % of the force.
    assert force[1].force_n[2] == pytest.approx(force[0].force_n[2], rel=5e-3)
    assert force[1].depth_mm < 0.1 < force[0].depth_mm


def test_many_at_once_press_the_dome_as_one_does() -> None:
    drawn = scene(8.0, (8.0, 6.0, 4.0), BALL, position_mm=(2.0, -1.2), depth_mm=0.3, steps=2, friction=0.4)
    drawn = drawn.model_copy(update={"numerics": Numerics(element="p1p1", tolerance=1e-9)})
    mesh = domed(brick(counts=(4, 4, 2)), 8.0)
    alone = simulate(drawn, mesh)
    (result,) = simulate_scenes([drawn], mesh)
    assert alone.status == result.status == "complete"
    assert len(alone.states) == len(result.states) == 3
    for one, other in zip(alone.states, result.states, strict=True):
        assert (one.depth_mm, one.shear_mm) == (other.depth_mm, other.shear_mm)
        # Both follow the way to 1e-3 and end at 1e-9 of the force; friction remembers the way, to some 1e-4 of it.
        np.testing.assert_allclose(one.force_n, other.force_n, atol=1e-3 * alone.states[-1].force_n[2])
    assert alone.states[-1].force_n[2] > 0.05
