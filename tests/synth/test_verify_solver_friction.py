"""Coulomb's law over whole trajectories: the cone, and the sliding limits T = μN and M = μ ∫ p r.

Each comment "fails with" names a change of `synth.simulate` that was tried.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from pads import MIXED, brick, run, scene

from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.simulate.stepping import Stepper

SIZE = (8.0, 6.0, 4.0)
PUNCH = {"shape": "cylinder", "radius_mm": 2.0, "length_mm": 6.0, "fillet_mm": 0.5}
BALL = {"shape": "sphere", "radius_mm": 3.0}
FILM = {"thickness_mm": 1.0, "youngs_modulus_kpa": 2000.0, "poisson_ratio": 0.499}


@dataclass(frozen=True)
class Touch:
    """Contact points of the end of a trajectory: (k, 3) positions in mm, normal and tangential traction, area (k,)."""

    stepper: Stepper
    position: FloatArray
    normal: FloatArray
    along: FloatArray
    area: FloatArray

    @property
    def pressure(self) -> FloatArray:
        return np.asarray(np.linalg.norm(self.normal, axis=1))


def pad(layers: bool) -> PadMesh:
    """Plain, or with the first of four planes of cells for a film."""
    plain = brick(SIZE, (4, 4, 4 if layers else 3))
    depth = plain.points[plain.tets][:, :, 2].mean(axis=1)
    return PadMesh(plain.points, plain.tets, SIZE, ((depth > 1.0) & layers).astype(np.int32))


def touch(
    element: str, friction: float, motion: dict, indenter: dict, layers: bool = False, step: float = 0.1
) -> Touch:
    posed = scene(
        SIZE,
        gel={"poisson_ratio": 0.5, "layers": [FILM] if layers else []},
        indenter=indenter,
        friction=friction,
        motion=motion,
        numerics={"element": element, "max_step_mm": step, "edge_length_mm": None},
    )
    stepper = run(posed, pad(layers))
    body, state = stepper.system, stepper.state
    stepper._place(stepper.at)
    body.residual(state, stepper.indenter)
    whole, along = body.traction.numpy()[0], body.tangential.numpy()[0]
    on = whole.any(axis=-1)
    nodes = (body.space.points + state.u)[body.space.faces]
    position = np.einsum("qa,fac->fqc", body.space.element.face_shape, nodes)
    return Touch(stepper, position[on], (whole - along)[on], along[on], body._faces.weight.numpy()[on])


@pytest.mark.parametrize("layers", [False, True])
@pytest.mark.parametrize("friction", [0.1, 0.5, 2.0])
@pytest.mark.parametrize("element", MIXED)
def test_traction_stays_in_its_cone(element: str, friction: float, layers: bool) -> None:
    """At every contact point after a press, a drag, a twist and back, at right angles to a pressure that pushes."""
    motion = {"depth_mm": 0.8, "shear_mm": [0.6, -0.3], "twist_deg": 20.0, "position_mm": [0.4, 0.2], "steps": 3}
    motion["then"] = [{"depth_mm": 0.6, "shear_mm": [0.2, 0.0], "twist_deg": 5.0}]
    # Fails with the limit 5 % too high, with the trial traction not projected on the surface, and with `rotation *`
    # left out of _trial (no convergence).
    made = touch(element, friction, motion, BALL, layers, step=0.25)
    length = np.linalg.norm(made.along, axis=1)
    # The return map scales to the limit: a few roundings.
    assert (length <= friction * made.pressure * (1 + 1e-12)).all()
    np.testing.assert_allclose((made.normal * made.along).sum(axis=1), 0.0, atol=1e-12 * made.pressure.max() ** 2)
    centre = made.stepper.indenter.centre.numpy()[0]
    assert ((made.position - centre) * made.normal > 0).any(axis=1).all()
    slip = length > friction * made.pressure * (1 - 1e-6)
    assert slip.any()
    assert friction < 2 or not slip.all()


@pytest.mark.parametrize("element", MIXED)
def test_sliding_punch_pulls_with_its_limit(element: str) -> None:
    """Dragged far beyond sticking, a flat punch is pulled by T = μN along the drag."""
    friction, shear = 0.2, np.array([0.9, 0.4])
    # Fails with the limit 5 % too high.
    made = touch(element, friction, {"depth_mm": 0.6, "shear_mm": list(shear), "steps": 2}, PUNCH)
    pull, load = ((made.area[:, None] * t).sum(axis=0) for t in (made.along, made.normal))
    total = (made.area * made.pressure).sum()
    # Points on the fillet lean, where their friction points up or down; at the rim of these coarse faces the gel's own
    # motion turns the slip sideways; and what touched in the last 0.1 mm of 1 mm may still stick.
    assert pull[:2] @ shear / np.linalg.norm(shear) == pytest.approx(friction * total, rel=0.03)
    assert abs(pull[0] * shear[1] - pull[1] * shear[0]) < 0.04 * np.linalg.norm(shear) * friction * total
    assert made.stepper.states[-1].slip_ratio > 0.95
    assert load[2] > 0.9 * total


@pytest.mark.parametrize("element", MIXED)
def test_spinning_punch_is_held_by_its_limit(element: str) -> None:
    """Turned far, the tractions go round: M = μ ∫ p r dA about the axis, against the twist's pull, and no net force."""
    friction = 0.1
    # Fails with the limit 5 % too high, and with slipping anchors moved to the point itself.
    made = touch(element, friction, {"depth_mm": 0.6, "twist_deg": 60.0, "steps": 2}, PUNCH)
    arm = made.position[:, :2]
    radius = np.linalg.norm(arm, axis=1)
    turning = arm[:, 0] * made.along[:, 1] - arm[:, 1] * made.along[:, 0]
    limit = friction * (made.area * made.pressure * radius).sum()
    # A positive twist carries the gel from +x toward +y. Near the axis slip per degree is small, but so is r.
    assert (made.area * turning).sum() == pytest.approx(limit, rel=0.03)
    net = (made.area[:, None] * made.along).sum(axis=0)
    assert np.linalg.norm(net[:2]) < 0.02 * friction * (made.area * made.pressure).sum()
