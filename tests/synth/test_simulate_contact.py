"""Contact and friction at the level of one evaluation: traction law, linearisation, multipliers and anchors."""

import numpy as np
import pytest
from pads import MIXED, areas, dense
from touching import INDENTERS, MESH, PENALTY, RADIUS, SLIP, STICK, sphere_law, touch

from synth.simulate.contact_friction import FAR
from synth.simulate.system import Unknowns

frictions = pytest.mark.parametrize("friction", [0.0, SLIP, 0.7, STICK])
each = pytest.mark.parametrize("element", MIXED)


@each
@frictions
@pytest.mark.parametrize("fresh", [0.0, 0.5])
def test_traction_is_the_law(friction: float, fresh: float, element: str) -> None:
    made = touch(friction, fresh=fresh, element=element)
    normal, along = sphere_law(made)
    below = made.body.space.points[made.body.space.faces][..., 2].max(axis=1) == 0
    assert 0.2 < (normal[below] != 0).any(axis=-1).mean() < 0.95  # some points touch and some do not
    found = made.tractions  # Rounding of a dozen operations on numbers of order 1
    np.testing.assert_allclose(found[0], normal, atol=1e-13)
    np.testing.assert_allclose(found[1], along, atol=1e-13)
    if fresh and friction:
        assert found[1][~made.anchored].any()


@pytest.mark.parametrize("shape", list(INDENTERS))
@frictions
@pytest.mark.parametrize(("fresh", "element"), [(0.0, "p1p1"), (0.5, "p1p1"), (1.0, "p1p1"), (0.5, "p2p1")])
def test_tangent_is_the_derivative_of_the_residual(friction: float, shape: str, fresh: float, element: str) -> None:
    made = touch(friction, shape, fresh=fresh, element=element)
    body = made.body
    tangent = body.tangent(made.state, made.indenters)
    assert (tangent.remainder is None) == (friction == 0 and shape != "mesh")
    matrix = dense(body, tangent)
    rng = np.random.default_rng(3)
    for _ in range(3):
        direction = Unknowns(rng.standard_normal(made.state.u.shape), rng.standard_normal(made.state.p.shape))
        direction.u[body.space.held] = 0.0
        h = 1e-7
        ends, modes = [], []
        for step in (h, -h):
            ends.append(made.evaluate(made.state.plus(direction, step)))
            modes.append(made.mode)
        # Points within h of touching or slipping would make the difference quotient meaningless; there are none.
        assert (modes[0] == modes[1]).all()
        difference = (ends[0] - ends[1]) / (2 * h)
        along = np.concatenate([direction.u.ravel(), direction.p.ravel()])[body.free]
        # Central difference: rounding 1e-16 * 1e2 / 1e-7, and h^2; the kernels' H is a central difference (1e-9).
        assert np.linalg.norm(matrix @ along - difference) < 1e-6 * np.linalg.norm(difference)


def test_what_was_evaluated_does_not_change_with_the_next_evaluation() -> None:
    """Gaps, tractions and tangents are returned, not left in arrays that the next call writes into."""
    made = touch(0.7)
    body, first, tangent = made.body, made.residual, made.body.tangent(made.state, made.indenters)
    before = [first.gap.numpy().copy(), first.tangential.numpy().copy(), first.traction.numpy().copy()]
    before += [tangent.values.copy(), tangent.remainder.data.copy()]
    deepest = first.deepest
    other = Unknowns(2 * made.state.u, made.state.p)
    assert body.residual(other, made.indenters).deepest != deepest
    body.tangent(other, made.indenters)
    after = [
        first.gap.numpy(),
        first.tangential.numpy(),
        first.traction.numpy(),
        tangent.values,
        tangent.remainder.data,
    ]
    assert first.deepest == deepest
    for one, another in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, another)


@each
def test_remainder_of_stick_is_antisymmetric(element: str) -> None:
    """(n (H m)^T - (H m) n^T) / 2: all else of old anchors and stick is in the symmetric part."""
    made = touch(1e6, element=element)
    assert set(made.mode.ravel()) == {0, 1}
    tangent = made.body.tangent(made.state, made.indenters)
    rest, upper = tangent.remainder.toarray(), made.body.matrix(tangent.values).toarray()
    np.testing.assert_allclose(rest, -rest.T, atol=1e-12 * np.abs(upper).max())
    # Tractions of about 1 on a curvature of 1 / 1.3, against the penalty of 7.
    assert 0 < np.abs(rest).max() < 0.5 * np.abs(upper).max()


@each
def test_nodal_forces_and_moments_are_the_tractions(element: str) -> None:
    """`forces` and the residual say the same: what the indenter does to the gel, the nodes get."""
    made = touch(0.7, element=element)
    body, space = made.body, made.body.space
    reaction = made.residual.nodal_forces
    force, moment, nodal = body.forces(made.state, made.residual)
    # Inner forces sum to zero (test_simulate_bulk), so the whole sum is minus the contact's.
    np.testing.assert_allclose(reaction.sum(axis=0), -force, atol=1e-11)
    np.testing.assert_allclose(np.cross(space.points + made.state.u, reaction).sum(axis=0), -moment, atol=1e-11)
    normal, along = sphere_law(made)
    weight = body._faces.weight.numpy()
    np.testing.assert_allclose(force, np.einsum("fq,fqc->c", weight, normal + along), rtol=1e-12)
    # The nodal mean keeps the resultant of the coated face: its integral with each node's share of area.
    coated = (space.points[space.faces][:, :, 2] == 0).all(axis=1)
    on_face = np.einsum("fq,fqc->c", weight[coated], (normal + along)[coated])
    area, share = areas(space.surface.nodes, space.surface.faces), np.zeros(len(nodal))
    # A node has a third of its linear faces' area; of a quadratic face a corner a twelfth, an edge's middle a quarter.
    part = [1 / 3] * 3 if space.element.order == 1 else [1 / 12] * 3 + [1 / 4] * 3
    np.add.at(share, space.surface.faces, area[:, None] * part)
    assert share.sum() == pytest.approx(MESH.size_mm[0] * MESH.size_mm[1], rel=1e-12)
    # Rounding; on quadratic faces the rule of 27 points sees the kinks of these functions to some 1e-3.
    scale = (1e-12 if space.element.order == 1 else 2e-3) * float(np.linalg.norm(on_face))
    np.testing.assert_allclose(share @ nodal, on_face, atol=scale)


def test_augmenting_takes_the_present_traction_and_deepest_is_the_largest_penetration() -> None:
    made = touch(0.7, multipliers=False)
    contact = made.body.contact
    normal, along = sphere_law(made)
    made.body.augment(made.residual, made.indenters)
    np.testing.assert_allclose(contact.normal.numpy()[0], np.linalg.norm(normal, axis=-1), atol=1e-13)
    np.testing.assert_allclose(contact.tangent.numpy()[0], along @ made.rotation, atol=1e-13)
    # Where the gap is closed exactly the traction then needs no penetration: t = lambda - eps g.
    again, _ = sphere_law(made)
    np.testing.assert_allclose(np.linalg.norm(again, axis=-1), 2 * np.linalg.norm(normal, axis=-1), atol=1e-12)
    made = touch(0.0)
    away = np.linalg.norm(made.points - made.centre, axis=-1)
    assert made.residual.deepest == pytest.approx(RADIUS - away.min(), abs=1e-14)
    made.indenters.centre.assign(np.array([[0.0, 0.0, -50.0]]))
    made.evaluate()
    assert (made.residual.deepest, made.body.slip_ratio(made.residual, made.indenters)) == (0.0, 0.0)


@pytest.mark.parametrize("fresh", [0.0, 0.5])
@pytest.mark.parametrize("multipliers", [False, True])
def test_settling_keeps_the_tractions(multipliers: bool, fresh: float) -> None:
    """Accepting a step moves no force: slipping points drag their anchors so far that they are just at the limit."""
    made = touch(0.2, multipliers=multipliers, fresh=fresh)
    body, contact, was = made.body, made.body.contact, made.anchored.copy()
    mode, before = made.mode, made.residual.traction.numpy()[0]
    assert {0, 1, 2} <= set(mode[was].ravel())
    assert fresh == 0 or {0, 1, 2} <= set(mode[~was].ravel())
    old = contact.anchor.numpy()[0].copy()
    body.update_contact_history(made.state, made.residual, made.indenters)
    moved = (contact.anchor.numpy()[0] != old).any(axis=-1)
    assert (moved[was] == (mode == 2)[was]).all()
    assert (made.anchored == (mode > 0)).all()
    assert not contact.normal.numpy()[0][mode == 0].any()
    made.evaluate()
    np.testing.assert_allclose(made.residual.traction.numpy()[0], before, atol=1e-12)
    near = made.residual.gap.numpy()[0] < FAR
    np.testing.assert_allclose(contact.place.numpy()[0][near], made.local[near], atol=1e-14)
    assert (contact.gap.numpy()[0] == made.residual.gap.numpy()[0]).all()


def test_new_contact_is_anchored_where_it_touched_unless_without_past_or_friction() -> None:
    """A point that came through the surface in a straight line is anchored where it passed it, also before a pass."""
    made = touch(STICK, multipliers=False, fresh=1.0)
    body, contact = made.body, made.body.contact
    place, gap = contact.place.numpy()[0].copy(), contact.gap.numpy()[0].copy()
    touching = made.mode > 0
    assert touching.any()
    body.update_contact_history(made.state, made.residual, made.indenters, new_only=1)
    assert (made.anchored == touching).all()
    assert (contact.gap.numpy()[0] == gap).all()  # the step is not accepted yet
    now = np.linalg.norm(made.local, axis=-1) - RADIUS
    share = (gap / (gap - now))[..., None]
    expected = place + share * (made.local - place)
    np.testing.assert_allclose(contact.anchor.numpy()[0][touching], expected[touching], atol=1e-13)
    # Before the first step, and where a point was too far off to be looked at.
    made = touch(0.7, multipliers=False, fresh=1.0)
    body, contact = made.body, made.body.contact
    contact.gap.fill_(FAR)
    made.evaluate()
    normal, along = made.tractions
    assert normal.any()
    assert not along.any()
    body.update_contact_history(made.state, made.residual, made.indenters)
    touching = normal.any(axis=-1)
    assert (made.anchored == touching).all()
    np.testing.assert_allclose(contact.anchor.numpy()[0][touching], made.local[touching], atol=1e-14)
    made.evaluate()
    # Anchors are where the points are but for rounding, which the penalty multiplies.
    np.testing.assert_allclose(made.tractions[1], 0.0, atol=1e-13)
    made = touch(0.0, multipliers=False, fresh=1.0)
    contact = made.body.contact
    anchor = contact.anchor.numpy().copy()
    made.evaluate()
    made.body.update_contact_history(made.state, made.residual, made.indenters)
    assert not made.anchored.any()
    assert (contact.anchor.numpy() == anchor).all()
    assert not made.tractions[1].any()


@pytest.mark.parametrize("friction", [0.0, SLIP, 0.7, STICK])
def test_slip_ratio_is_the_slipping_share_of_area(friction: float) -> None:
    """1 without friction: then all that touches slips."""
    made = touch(friction, fresh=0.5)
    weight, mode = made.body._faces.weight.numpy(), made.mode
    expected = weight[mode == 2].sum() / weight[mode > 0].sum()
    assert made.body.slip_ratio(made.residual, made.indenters) == pytest.approx(expected, rel=1e-12)
    assert {0.0: expected == 1, 0.7: 0 < expected < 1, STICK: expected < 0.1}.get(friction, expected > 0.8)


@each
def test_sides_are_touched_like_the_face(element: str) -> None:
    """A ball beside the pad, at half its height: only side faces touch, and the law holds there."""
    made = touch(0.0, element=element)
    made.body.contact.anchored.zero_()
    made.body.contact.normal.zero_()
    centre = np.array([MESH.size_mm[0] / 2 + RADIUS - 0.4, 0.0, MESH.size_mm[2] / 2])
    made.indenters.centre.assign(centre[None])
    made.evaluate()
    space = made.body.space
    touching = made.mode > 0
    sides = (space.points[space.faces][:, :, 0] == MESH.size_mm[0] / 2).all(axis=1)
    assert touching[sides].any()
    assert not touching[~sides].any()
    away = made.points - centre
    distance = np.linalg.norm(away, axis=-1, keepdims=True)
    expected = PENALTY * np.maximum(RADIUS - distance, 0) * away / distance
    np.testing.assert_allclose(made.tractions[0], expected, atol=1e-13)
    force = made.body.forces(made.state, made.residual)[0]
    assert force[0] < -10 * np.hypot(*force[1:])
