"""Contact and friction at the level of one evaluation: traction law, linearisation, multipliers and anchors.

Each comment "fails with" names a change of `synth.simulate.contact` that was tried.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from pads import crooked, everything, indenters, scene, system
from scipy.sparse import csr_matrix

from synth.arrays import FloatArray
from synth.simulate.contact import Indenters
from synth.simulate.system import System, Unknowns

MESH = crooked()
PENALTY = 7.0
SLIP, STICK = 0.05, 10.0
"""Friction coefficients at which, with the random anchors below, nearly every point slips or sticks."""


@dataclass
class Touch:
    """A gel pressed by a tilted, turned block or a ball, its friction state random."""

    body: System
    state: Unknowns
    indenters: Indenters
    friction: float

    def evaluate(self, state: Unknowns | None = None) -> FloatArray:
        """Free residual."""
        return self.body.balance(state or self.state, self.indenters, everything(self.body)).free[0]

    @property
    def points(self) -> FloatArray:
        """(f, q, 3) positions of the contact points."""
        nodes = (MESH.points + self.state.u[0])[self.body._face_nodes]
        return np.einsum("qa,fac->fqc", self.body._faces.shape.numpy(), nodes)


INDENTERS = {
    "sphere": {"shape": "sphere", "radius_mm": 1.3, "rotation_deg": [10.0, 20.0, 30.0]},
    "torus": {"shape": "torus", "radius_mm": 0.9, "tube_mm": 0.4, "rotation_deg": [10.0, 20.0, 30.0]},
}


def touch(friction: float, shape: str = "sphere", multipliers: bool = True, seed: int = 1) -> Touch:
    rng = np.random.default_rng(seed)
    body = system(MESH, 0.4999, symmetric=False, penalty=PENALTY)
    posed = scene(MESH.size_mm, indenter=INDENTERS[shape], friction=friction, motion={"depth_mm": 0.5})
    made = Touch(
        body,
        Unknowns(0.04 * rng.standard_normal((1, body.nodes, 3)), rng.standard_normal((1, body.nodes))),
        indenters(posed, 0.5),
        friction,
    )
    made.state.u[0, MESH.bonded] = 0.0
    rotation = made.indenters.rotation.numpy()[0]
    local = (made.points - made.indenters.centre.numpy()[0]) @ rotation
    body.contact.anchor.assign((local + (0.01 if friction == STICK else 0.15) * rng.standard_normal(local.shape))[None])
    body.contact.anchored.assign(np.ones((1, *local.shape[:2]), dtype=np.int32))
    if multipliers:
        body.contact.normal.assign(0.3 * rng.random((1, *local.shape[:2])))
        body.contact.tangent.assign(0.1 * rng.standard_normal((1, *local.shape)))
    made.evaluate()
    return made


def sphere_law(made: Touch) -> tuple[FloatArray, FloatArray]:
    """Normal and tangential traction (f, q, 3) of a ball by the formulas of the module's docstring."""
    contact, rotation = made.body.contact, made.indenters.rotation.numpy()[0]
    away = made.points - made.indenters.centre.numpy()[0]
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    n = away / distance
    pressure = np.maximum(contact.normal.numpy()[0][..., None] - PENALTY * (distance - 1.3), 0.0)
    trial = contact.tangent.numpy()[0] @ rotation.T - PENALTY * (away - contact.anchor.numpy()[0] @ rotation.T)
    trial = trial - (trial * n).sum(-1, keepdims=True) * n
    length = np.linalg.norm(trial, axis=-1, keepdims=True)
    anchored = contact.anchored.numpy()[0][..., None] == 1
    share = np.where(anchored, np.minimum(1.0, made.friction * pressure / np.maximum(length, 1e-300)), 0.0)
    return pressure * n, np.where(pressure > 0, share * trial, 0.0)


@pytest.mark.parametrize("friction", [0.0, SLIP, 0.7, STICK])
def test_traction_is_the_law(friction: float) -> None:
    # Fails with the sign of y - a turned, or `limit / length` left out of _returned.
    made = touch(friction)
    normal, along = sphere_law(made)
    assert 0.2 < (normal != 0).any(axis=-1).mean() < 0.95  # some points touch and some do not
    # Rounding of a dozen operations on numbers of order 1.
    np.testing.assert_allclose(made.body.traction.numpy()[0], normal + along, atol=1e-13)
    np.testing.assert_allclose(made.body.tangential.numpy()[0], along, atol=1e-13)


@pytest.mark.parametrize("shape", list(INDENTERS))
@pytest.mark.parametrize("friction", [SLIP, 0.7, STICK])
def test_friction_stays_in_its_cone_and_plane(friction: float, shape: str) -> None:
    made = touch(friction, shape)
    along = made.body.tangential.numpy()[0]
    normal = made.body.traction.numpy()[0] - along
    pressure, length = np.linalg.norm(normal, axis=-1), np.linalg.norm(along, axis=-1)
    assert (length <= friction * pressure * (1 + 1e-12)).all()
    np.testing.assert_allclose((normal * along).sum(axis=-1), 0.0, atol=1e-13)
    slipping = length > friction * pressure * (1 - 1e-9)
    share = slipping[pressure > 0].mean()
    assert {SLIP: share > 0.9, STICK: share < 0.1}.get(friction, 0.1 < share < 0.9)


@pytest.mark.parametrize("shape", list(INDENTERS))
@pytest.mark.parametrize("friction", [0.0, SLIP, 0.7, STICK])
def test_tangent_is_the_derivative_of_the_residual(friction: float, shape: str) -> None:
    # Fails with the sign of pressure * H turned, without (n.m) H or n (H m)^T, without mu eps tau n^T, without
    # I - tau tau^T, or with limit / length for one.
    made = touch(friction, shape)
    body = made.body
    values = body.tangent(made.state, made.indenters, everything(body))[0]
    size = len(body.free)
    matrix = csr_matrix((values, body.indices, body.indptr), shape=(size, size))
    rng = np.random.default_rng(3)
    for _ in range(3):
        direction = Unknowns(rng.standard_normal(made.state.u.shape), rng.standard_normal(made.state.p.shape))
        direction.u[0, MESH.bonded] = 0.0
        h = 1e-6
        ends, modes = [], []
        for step in (h, -h):
            ends.append(made.evaluate(made.state.plus(direction, np.array([step]))))
            modes.append(contact_mode(made))
        # Points within h of touching or slipping would make the difference quotient meaningless; there are none.
        assert (modes[0] == modes[1]).all()
        difference = (ends[0] - ends[1]) / (2 * h)
        along = np.concatenate([direction.u.ravel(), direction.p.ravel()])[body.free]
        # Central difference: rounding 1e-16 * 1e2 / 1e-6 of the residual and h^2 of its third derivative; the
        # kernels' H is a central difference itself (1e-9).
        assert np.linalg.norm(matrix @ along - difference) < 1e-6 * np.linalg.norm(difference)


def contact_mode(made: Touch) -> np.ndarray:
    """0 off, 1 stick, 2 slip."""
    along = made.body.tangential.numpy()[0]
    pressure = np.linalg.norm(made.body.traction.numpy()[0] - along, axis=-1)
    slip = np.linalg.norm(along, axis=-1) > made.friction * pressure * (1 - 1e-9)
    return np.where(pressure > 0, 1 + slip, 0)


def test_tangent_without_friction_is_symmetric() -> None:
    made = touch(0.0, "torus")
    values = made.body.tangent(made.state, made.indenters, everything(made.body))[0]
    size = len(made.body.free)
    matrix = csr_matrix((values, made.body.indices, made.body.indptr), shape=(size, size)).toarray()
    # Rounding of sums of some hundred entries.
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.abs(matrix).max())


def test_nodal_forces_and_moments_are_the_tractions() -> None:
    """`forces` and the residual say the same: what the indenter does to the gel, the nodes get."""
    # Fails with the position of the undeformed points in `forces`.
    made = touch(0.7)
    body = made.body
    reaction = body.balance(made.state, made.indenters, everything(body)).reaction[0]
    force, moment, nodal = (values[0] for values in body.forces(made.state))
    # Inner forces sum to zero (test_simulate_bulk), so the whole sum is minus the contact's.
    np.testing.assert_allclose(reaction.sum(axis=0), -force, atol=1e-11)
    np.testing.assert_allclose(np.cross(MESH.points + made.state.u[0], reaction).sum(axis=0), -moment, atol=1e-11)
    normal, along = sphere_law(made)
    weight = body._faces.weight.numpy()
    np.testing.assert_allclose(force, np.einsum("fq,fqc->c", weight, normal + along), rtol=1e-12)
    # The nodal mean keeps the resultant: its integral with each node's share of area is the force.
    share = np.zeros(len(nodal))
    np.add.at(share, MESH.contact_faces.faces, weight.sum(axis=1)[:, None] / 3)
    np.testing.assert_allclose(share @ nodal, force, rtol=1e-12)
    assert share.sum() == pytest.approx(MESH.size_mm[0] * MESH.size_mm[1], rel=1e-12)


def test_law_does_not_depend_on_the_frame() -> None:
    """Gel and indenter turned together about z: tractions turn with them, because anchors are the indenter's."""
    # Fails with `rotation *` left out of _trial.
    made = touch(0.7)
    before = made.body.traction.numpy()[0].copy()
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    made.indenters.centre.assign((made.indenters.centre.numpy()[0] @ turn.T)[None])
    made.indenters.rotation.assign((turn @ made.indenters.rotation.numpy()[0])[None])
    turned = (MESH.points + made.state.u[0]) @ turn.T - MESH.points
    made.evaluate(Unknowns(turned[None], made.state.p))
    np.testing.assert_allclose(made.body.traction.numpy()[0], before @ turn.T, atol=1e-13)


def test_augmenting_takes_the_present_traction() -> None:
    made = touch(0.7, multipliers=False)
    contact, rotation = made.body.contact, made.indenters.rotation.numpy()[0]
    normal, along = sphere_law(made)
    made.body.augment(made.state, made.indenters, everything(made.body))
    np.testing.assert_allclose(contact.normal.numpy()[0], np.linalg.norm(normal, axis=-1), atol=1e-13)
    np.testing.assert_allclose(contact.tangent.numpy()[0], along @ rotation, atol=1e-13)
    # Where the gap is closed exactly the traction then needs no penetration: t = lambda - eps g.
    again, _ = sphere_law(made)
    np.testing.assert_allclose(np.linalg.norm(again, axis=-1), 2 * np.linalg.norm(normal, axis=-1), atol=1e-12)


@pytest.mark.parametrize("multipliers", [False, True])
def test_settling_keeps_the_tractions(multipliers: bool) -> None:
    """Accepting a step moves no force: slipping points drag their anchors so far that they are just at the limit."""
    # Fails with the sign of the anchor's correction turned, with the multiplier left out of it, with 1.0 for ON_CONE (a
    # quarter of the slipping points then leave their anchors behind).
    made = touch(0.2, multipliers=multipliers)
    body, contact = made.body, made.body.contact
    mode, before = contact_mode(made), body.traction.numpy()[0].copy()  # Warp's arrays are views
    assert {0, 1, 2} <= set(mode.ravel())
    old = contact.anchor.numpy()[0].copy()
    body.settle(made.state, made.indenters, everything(body))
    moved = (contact.anchor.numpy()[0] != old).any(axis=-1)
    assert (moved == (mode == 2)).all()
    assert (contact.anchored.numpy()[0] == (mode > 0)).all()
    assert not contact.normal.numpy()[0][mode == 0].any()
    made.evaluate()
    np.testing.assert_allclose(body.traction.numpy()[0], before, atol=1e-12)


def test_new_contact_is_anchored_where_it_is() -> None:
    made = touch(0.7, multipliers=False)
    body, contact = made.body, made.body.contact
    contact.anchored.zero_()
    made.evaluate()
    assert not body.tangential.numpy().any()  # no friction during the step in which a point touches
    touching = body.traction.numpy()[0].any(axis=-1)
    body.settle(made.state, made.indenters, everything(body))
    assert (contact.anchored.numpy()[0] == touching).all()
    local = (made.points - made.indenters.centre.numpy()[0]) @ made.indenters.rotation.numpy()[0]
    np.testing.assert_allclose(contact.anchor.numpy()[0][touching], local[touching], atol=1e-14)
    made.evaluate()
    # Anchors are where the points are but for rounding, which the penalty multiplies.
    np.testing.assert_allclose(body.tangential.numpy(), 0.0, atol=1e-13)


def test_no_friction_no_state() -> None:
    # Fails without the test of friction in `settle`.
    made = touch(0.0, multipliers=False)
    contact = made.body.contact
    contact.anchored.zero_()
    anchor = contact.anchor.numpy().copy()
    made.evaluate()
    made.body.settle(made.state, made.indenters, everything(made.body))
    assert not contact.anchored.numpy().any()
    assert (contact.anchor.numpy() == anchor).all()
    assert not made.body.tangential.numpy().any()


def test_deepest_is_the_largest_penetration() -> None:
    made = touch(0.0)
    away = np.linalg.norm(made.points - made.indenters.centre.numpy()[0], axis=-1)
    assert made.body.deepest()[0] == pytest.approx(1.3 - away.min(), abs=1e-14)
    made.indenters.centre.assign(np.array([[0.0, 0.0, -50.0]]))
    made.evaluate()
    assert made.body.deepest()[0] == 0.0
