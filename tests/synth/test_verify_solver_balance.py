"""What the indenter exerts, the window bears: forces and moments, with the stresses integrated in numpy.

`integrals` finds stresses and nodal forces from displacements and pressures apart from the solver's kernels.
"""

import numpy as np
import pytest
from integrals import own_integrals
from layered_pad import FILM, pad
from pads import MIXED, SIZE, run, scene

from synth.arrays import FloatArray
from synth.scene import Scene
from synth.simulate import simulate
from synth.simulate.material import pad_material
from synth.simulate.space import Space

E_MPA = 0.2
DRAG = {"depth_mm": 0.8, "shear_mm": [0.5, -0.3], "twist_deg": 10.0, "position_mm": [0.4, 0.2], "steps": 3}
LEGS = [{"depth_mm": z, "shear_mm": shear} for z, shear in ((3, (3.1, 0.1)), (3, (2.5, 0.1)), (2.8, (2.5, 0.4)))]
BESIDE = {"depth_mm": -0.1, "position_mm": [4.0, 0.2], "shear_mm": [3.1, 0.1], "then": LEGS, "steps": 5}
"""Down beside the pad, into its side face, and along it."""


def case(element: str, nu: float, friction: float, motion: dict, layers: bool = False) -> Scene:
    gel = {"poisson_ratio": nu, "stiffening": (0.1, 0.02), "layers": [FILM] if layers else []}
    numerics = {"element": element, "tolerance": 1e-9, "edge_length_mm": None}
    return scene(SIZE, gel=gel, numerics=numerics, friction=friction, motion=motion)


def check(space: Space, displacement: FloatArray, internal: FloatArray, force: FloatArray, moment: FloatArray) -> None:
    """Reactions (from nodal forces `internal`) against the indenter's force and moment, all over E."""
    # Newton stops at 1e-9 of the nodal forces; their sum over some 1e3 nodes, on arms of 5 mm, may be 1e3 as much.
    scale = float(1e-6 * np.linalg.norm(internal))
    assert np.linalg.norm(force) > 1e3 * scale
    held = internal * space.held
    np.testing.assert_allclose(held.sum(axis=0), -force, atol=scale)
    np.testing.assert_allclose(np.cross(space.points + displacement, held).sum(axis=0), -moment, atol=scale)
    inside = np.ones(len(space.points), dtype=bool)
    inside[space.faces] = False
    inside[space.held[:, 0]] = False
    np.testing.assert_allclose(internal[inside], 0.0, atol=scale)


@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("element", MIXED)
def test_recorded_displacement_and_force_belong_together(element: str, friction: float) -> None:
    """Of a foam, whose stress is the displacement's alone: what the user gets, with multipliers and all."""
    posed, mesh = case(element, 0.2, friction, DRAG), pad(False)
    result = simulate(posed, mesh)
    assert result.status == "complete"
    rule, material = own_integrals(result.space), pad_material(posed.sensor.gel, mesh)
    for state in result.states[1:]:
        internal = rule.forces(rule.stress(material, state.displacement, np.zeros(0)))
        force, moment = np.array(state.force_n) / E_MPA, np.array(state.torque_nmm) / E_MPA
        check(result.space, state.displacement, internal, force, moment)


@pytest.mark.parametrize(
    ("nu", "motion", "friction", "layers"),
    [(0.4999, DRAG, 0.6, True), (0.5, DRAG, 0.0, True), (0.5, DRAG, 0.6, False), (0.4999, BESIDE, 0.6, False)],
)
@pytest.mark.parametrize("element", MIXED)
def test_window_bears_what_the_indenter_does(element, nu, motion, friction, layers) -> None:
    """With a pressure field, a stiff film, and from the side."""
    posed, mesh = case(element, nu, friction, motion, layers), pad(layers)
    stepper = run(posed, mesh)
    body, state = stepper.system, stepper.state
    stepper._place(stepper.at)
    body.residual(state, stepper.indenter)
    force, moment = body.forces(state)[:2]
    rule, material = own_integrals(body.space), pad_material(posed.sensor.gel, mesh)
    check(body.space, state.u, rule.forces(rule.stress(material, state.u, state.p)), force, moment)
    if motion is BESIDE:
        sideways = body.traction.numpy()[0][(body.space.points[body.space.faces][:, :, 0] == SIZE[0] / 2).all(axis=1)]
        assert sideways.any()
