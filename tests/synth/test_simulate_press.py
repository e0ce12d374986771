"""Whole trajectories: balance of forces, symmetry, scaling, friction, batches, and honest failure.

Each comment "fails with" names a change of `synth.simulate` that was tried.
"""

from functools import cache
from pathlib import Path as FilePath

import numpy as np
import pytest
from pads import brick, scene

import synth.simulate.linear as linear
import synth.simulate.stepping as stepping
import synth.simulate.system as system_module
from synth.errors import InputError
from synth.scene import Scene
from synth.simulate import Trajectory, simulate, simulate_batch
from synth.simulate.element import p1p1
from synth.simulate.indenter import rigid_body
from synth.simulate.path import Path
from synth.simulate.stepping import Stepper
from synth.simulate.system import System

MESH = brick()
PUNCH = {"shape": "cylinder", "radius_mm": 2.0, "length_mm": 6.0, "fillet_mm": 0.5}
DRAG = {"depth_mm": 0.6, "shear_mm": [0.8, -0.3], "twist_deg": 10.0, "position_mm": [0.4, 0.2], "steps": 4}
TOLERANCE = 1e-6


def gentle(**parts: object) -> Scene:
    return scene(**{"friction": 0.4, "motion": DRAG, **parts})


@cache
def dragged() -> Trajectory:
    return simulate(gentle(), MESH)


def run(posed: Scene) -> Stepper:
    """A stepper at the end of a scene's path."""
    mu = posed.contact.friction
    body = System(MESH, posed.sensor.gel.poisson_ratio, 1, mu == 0, posed.numerics.penalty, p1p1())
    path = Path(posed.motion, rigid_body(posed.contact.indenter, resolution_mm=0.5))
    stepper = Stepper(body, [path], [mu], posed.numerics, [posed.sensor.gel.youngs_modulus_kpa / 1000])
    assert stepper.run()[0].status == "complete"
    return stepper


def same(a: Trajectory, b: Trajectory) -> bool:
    """Bitwise, but for the time it took."""
    assert (a.status, a.reason, len(a.states)) == (b.status, b.reason, len(b.states))
    return all(
        (s.displacement == t.displacement).all() and (s.traction == t.traction).all() and s.summary() == t.summary()
        for s, t in zip(a.states, b.states, strict=True)
    )


def test_records_what_was_asked() -> None:
    result = dragged()
    assert (result.status, result.reason) == ("complete", "")
    assert len(result.states) == DRAG["steps"] + 1
    rest, last = result.states[0], result.states[-1]
    assert not rest.displacement.any()
    assert rest.force_n == (0.0, 0.0, 0.0)
    assert (last.depth_mm, last.shear_mm, last.twist_deg) == (0.6, pytest.approx((0.8, -0.3)), pytest.approx(10.0))
    for state in result.states[1:]:
        assert state.residual <= TOLERANCE
        assert 0 < state.min_jacobian < 1
        assert state.newton_iterations > 0
        assert state.force_n[2] > 0  # a press pushes the gel toward the camera
        assert 0 <= state.max_penetration_mm < 0.1
        assert not state.displacement[MESH.bonded].any()


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_window_bears_what_the_indenter_does(friction: float) -> None:
    """The bonded face's reaction balances the contact force and moment.

    Fails with the undeformed arm in `forces`, with contact not restored after a record, or its gap not evaluated anew.
    """
    stepper = run(gentle(friction=friction))
    body, last = stepper.system, stepper.samples[0].at
    stepper._place([last])
    balance = body.balance(stepper.state, stepper.indenters, np.array([True]))
    force, moment, _ = (values[0] for values in body.forces(stepper.state))
    held = balance.reaction[0] * MESH.bonded[:, None]
    # What is left on the free nodes is the residual: 1e-6 of the nodal forces' norm, on some 100 nodes and arms of 5
    # mm.
    scale = 10 * TOLERANCE * np.linalg.norm(balance.reaction)
    assert np.linalg.norm(force) > 1e3 * scale
    np.testing.assert_allclose(held.sum(axis=0), -force, atol=scale)
    held_moment = np.cross(MESH.points + stepper.state.u[0], held).sum(axis=0)
    np.testing.assert_allclose(held_moment, -moment, atol=5 * scale)


@pytest.mark.parametrize("indenter", [{"shape": "sphere", "radius_mm": 3.0}, PUNCH])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_centred_press_is_mirror_symmetric(indenter: dict, friction: float) -> None:
    motion = {"depth_mm": 0.8, "steps": 2}
    last = simulate(scene(indenter=indenter, friction=friction, motion=motion), MESH).states[-1]
    fx, fy, fz = last.force_n
    # The mesh is its own mirror image; Newton stops at 1e-6 of the forces, and usually far below.
    assert max(abs(fx), abs(fy)) < TOLERANCE * fz
    assert np.abs(last.torque_nmm).max() < 10 * TOLERANCE * fz
    for axis in (0, 1):
        sign = np.ones(3)
        sign[axis] = -1
        image = {tuple(np.round(x, 6)): u for x, u in zip(MESH.points * sign, last.displacement * sign, strict=True)}
        mirrored = np.array([image[tuple(np.round(x, 6) + 0.0)] for x in MESH.points])
        np.testing.assert_allclose(mirrored, last.displacement, atol=10 * TOLERANCE)


def test_mirrored_motion_gives_the_mirrored_state() -> None:
    # Fails with abs() around the twist in `pose`.
    motion = {**DRAG, "shear_mm": [-0.8, -0.3], "twist_deg": -10.0, "position_mm": [-0.4, 0.2]}
    one, other = dragged().states[-1], simulate(gentle(motion=motion), MESH).states[-1]
    # Newton stops at 1e-6 on every step, and loosely (1e-3) between the records, whose errors friction remembers.
    np.testing.assert_allclose(other.force_n, np.array(one.force_n) * [-1, 1, 1], rtol=2e-3)
    np.testing.assert_allclose(other.torque_nmm, np.array(one.torque_nmm) * [1, -1, -1], rtol=2e-3, atol=1e-3)


def test_youngs_modulus_scales_forces_only() -> None:
    # Fails with the modulus left out of a record.
    hard = simulate(gentle(gel={"youngs_modulus_kpa": 200e3}), MESH)
    for s, t in zip(dragged().states, hard.states, strict=True):
        assert (s.displacement == t.displacement).all()
        np.testing.assert_allclose(t.force_n, 1000 * np.array(s.force_n), rtol=1e-14)
        np.testing.assert_allclose(t.torque_nmm, 1000 * np.array(s.torque_nmm), rtol=1e-14)
        np.testing.assert_allclose(t.traction, 1000 * s.traction, rtol=1e-14)
        assert (s.residual, s.newton_iterations) == (t.residual, t.newton_iterations)


def test_same_call_twice_is_bitwise_the_same() -> None:
    assert same(simulate(gentle(), MESH), dragged())


def test_without_friction_nothing_pulls_sideways() -> None:
    """No tangential traction anywhere, so the ball's force goes through its centre, and its twist does nothing."""
    stepper = run(gentle(friction=0.0, motion={**DRAG, "shear_mm": [0.0, 0.0]}))
    assert not stepper.system.tangential.numpy().any()
    states = stepper.samples[0].states
    pressed, twisted = states[1:3], states[-1]
    centre = np.array([0.4, 0.2, 0.6 - 3.0])
    for state in (pressed[-1], twisted):
        about = np.array(state.torque_nmm) - np.cross(centre, state.force_n)
        # Forces along the radii of a ball have no moment about its centre: rounding only.
        np.testing.assert_allclose(about, 0.0, atol=1e-12)
    np.testing.assert_allclose(twisted.force_n, states[2].force_n, rtol=10 * TOLERANCE, atol=1e-7)


def test_friction_drags_the_gel_along() -> None:
    # Fails with the sign of the trial traction turned.
    for shear in ([0.4, 0.0], [0.0, -0.4]):
        motion = {"depth_mm": 0.6, "shear_mm": shear, "steps": 3}
        force = simulate(scene(friction=0.8, motion=motion), MESH).states[-1].force_n
        assert np.dot(force[:2], shear) > 0.05 * force[2] * 0.4
        assert abs(np.cross(force[:2], shear)) < 0.02 * force[2] * 0.4


@pytest.mark.parametrize("twist", [15.0, -15.0])
def test_twist_turns_the_gel_along(twist: float) -> None:
    motion = {"depth_mm": 0.6, "twist_deg": twist, "steps": 3}
    last = simulate(scene(friction=0.8, motion=motion), MESH).states[-1]
    assert last.torque_nmm[2] * np.sign(twist) > 0.05 * last.force_n[2]
    below = MESH.points[:, 2] == 0
    x, u = MESH.points[below], last.displacement[below]
    near = (np.hypot(x[:, 0], x[:, 1]) > 0.1) & (np.hypot(x[:, 0], x[:, 1]) < 2.1)
    assert near.any()
    turned = x[near, 0] * u[near, 1] - x[near, 1] * u[near, 0]  # positive: from +x toward +y
    assert (turned * np.sign(twist) > 0).all()


def test_long_shear_slides_at_the_friction_coefficient() -> None:
    """A flat punch dragged far slips everywhere: |t_T| = mu t_n at each point, and T / N tends to mu."""
    # Fails with the limit of _returned halved, or without anchors.
    mu = 0.3
    motion = {"depth_mm": 0.4, "shear_mm": [3.0, 0.0], "position_mm": [-1.8, 0.0], "steps": 4}
    stepper = run(scene(indenter=PUNCH, friction=mu, motion=motion, numerics={"max_step_mm": 0.1}))
    body, last = stepper.system, stepper.samples[0].states[-1]
    stepper._place([stepper.samples[0].at])
    body.balance(stepper.state, stepper.indenters, np.array([True]))
    along, weight = body.tangential.numpy()[0], body._faces.weight.numpy()
    normal = body.traction.numpy()[0] - along
    pressure, length = np.linalg.norm(normal, axis=-1), np.linalg.norm(along, axis=-1)
    assert (length <= mu * pressure * (1 + 1e-9)).all()
    slipping = length >= mu * pressure * (1 - 1e-6)
    # All slips but what touched in the last step, which has no friction yet: 0.1 mm of 4 mm, some 3 %.
    assert (weight * pressure)[slipping].sum() > 0.97 * (weight * pressure).sum()
    pull = np.einsum("fq,fqc->c", weight, along)
    load = np.einsum("fq,fqc->c", weight, normal)
    assert pull[0] / load[2] == pytest.approx(mu, rel=0.03)
    assert abs(pull[1]) < 0.01 * pull[0]
    # The recorded force has the pressure's sideways part, too: the rim's normals lean by up to a fifth.
    assert last.force_n[0] / last.force_n[2] == pytest.approx(mu + load[0] / load[2], rel=0.05)


def test_each_of_a_batch_is_as_if_it_were_alone(tmp_path: FilePath) -> None:
    """Six very different scenes, bitwise: no touch, no friction, friction, and mesh indenters of unequal grids."""
    # Fails with one matrix for scenes with and without friction, or with a strided residual in System.balance.
    import pyvista as pv

    pv.Icosphere(radius=2.5, nsub=3).save(tmp_path / "large.stl")
    pv.Cube(x_length=2.0, y_length=1.5, z_length=1.0).triangulate().save(tmp_path / "small.stl")
    short = {"depth_mm": 0.5, "shear_mm": [0.2, 0.1], "steps": 2}
    scenes = [
        gentle(motion={**DRAG, "depth_mm": -1.0}),
        gentle(friction=0.0),
        gentle(gel={"youngs_modulus_kpa": 50.0}, indenter=PUNCH, motion=short),
        gentle(indenter={"shape": "mesh", "file": "large.stl", "cell_mm": 0.3}, motion=short),
        gentle(
            indenter={"shape": "mesh", "file": "small.stl", "cell_mm": 0.25}, motion={**short, "position_mm": [-1, 1]}
        ),
        gentle(indenter={"shape": "torus", "radius_mm": 1.5, "tube_mm": 0.7}, motion=short),
    ]
    together = simulate_batch(scenes, MESH, tmp_path)
    assert [result.status for result in together[:5]] == ["complete"] * 5
    for posed, result in zip(scenes, together, strict=True):
        assert same(simulate(posed, MESH, tmp_path), result)
    order = [4, 1, 3, 0, 2, 5]
    for i, result in zip(order, simulate_batch([scenes[i] for i in order], MESH, tmp_path), strict=True):
        assert same(result, together[i])


def test_batch_must_share_the_pad() -> None:
    with pytest.raises(InputError, match=r"mm pad"):
        simulate(scene((8.0, 6.0, 3.0)), MESH)
    with pytest.raises(InputError, match="poisson_ratio"):
        simulate_batch([gentle(), gentle(gel={"poisson_ratio": 0.45})], MESH)


def test_no_touch_needs_no_solve(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("solved")

    monkeypatch.setattr(stepping, "solve", never)
    for depth in (-0.5, 0.0):
        result = simulate(gentle(motion={**DRAG, "depth_mm": depth}), MESH)
        assert (result.status, len(result.states)) == ("complete", 5)
        assert not any(
            state.displacement.any() or state.traction.any() or any(state.force_n) for state in result.states
        )
        assert result.states[-1].depth_mm == depth
        assert result.states[-1].shear_mm == pytest.approx((0.8, -0.3))


def test_body_beside_the_pad_touches_nothing() -> None:
    ring = {"shape": "torus", "radius_mm": 9.0, "tube_mm": 0.5}
    result = simulate(gentle(indenter=ring), MESH)
    assert result.status == "complete"
    assert not any(state.displacement.any() or any(state.force_n) for state in result.states)


def test_slides_off_the_pad() -> None:
    """Once the indenter has left, the gel springs back: only rounding is left, and that is balance enough."""
    # Fails with the relative residual not floored by NOTHING.
    motion = {"depth_mm": 0.3, "shear_mm": [6.0, 0.0], "position_mm": [3.0, 0.0], "steps": 6}
    result = simulate(scene(indenter={"shape": "sphere", "radius_mm": 2.0}, friction=0.1, motion=motion), MESH)
    assert (result.status, result.reason) == ("complete", "")
    assert result.states[1].force_n[2] > 1e-3
    assert np.abs(result.states[-1].displacement).max() < 1e-9
    assert np.abs(result.states[-1].force_n).max() < 1e-9


WIRE = scene(
    indenter={"shape": "torus", "radius_mm": 1.5, "tube_mm": 0.3},
    friction=0.2,
    motion={"depth_mm": 3.3, "steps": 8},
    numerics={"edge_length_mm": 0.1},
)
"""A ring of thin wire pressed through four fifths of a pad whose faces are three times as wide as the wire."""


def test_hopeless_press_ends_honestly() -> None:
    result = simulate(WIRE, MESH)
    assert result.status == "partial"
    assert "no balance" in result.reason
    assert 1 < len(result.states) < 9
    for state in result.states:
        assert state.residual <= TOLERANCE
        assert state.min_jacobian > 0
        assert np.isfinite(state.displacement).all()
        assert 0 <= state.force_n[2] < 20.0  # N; a pad squeezed flat by a whole ball takes some 40


@pytest.mark.parametrize("broken", ["singular", "nonsense"])
def test_a_solver_that_fails_is_a_failed_trajectory(monkeypatch: pytest.MonkeyPatch, broken: str) -> None:
    class Broken:
        def solve(self, values: np.ndarray, right: np.ndarray) -> np.ndarray:
            return np.full_like(right, np.nan if broken == "singular" else 1e3)

    monkeypatch.setattr(system_module, "direct_solver", lambda *_: Broken())
    result = simulate(gentle(), MESH)
    assert result.status == "failed"
    assert len(result.states) == 1
    assert "no balance" in result.reason


def test_one_bad_sample_does_not_spoil_its_batch() -> None:
    numerics = {"edge_length_mm": 0.1}
    lost, kept = simulate_batch([WIRE, gentle(numerics=numerics)], MESH)
    assert lost.status == "partial"
    assert same(kept, simulate(gentle(numerics=numerics), MESH))


def test_step_length_does_not_change_a_press_without_friction() -> None:
    """Without friction the end does not remember the way."""
    # Fails with Newton stopped at a residual of 0.3.
    motion = {"depth_mm": 0.8, "steps": 2}
    ends = [simulate(scene(motion=motion, numerics={"max_step_mm": h}), MESH).states[-1] for h in (0.4, 0.25, 0.05)]
    for end in ends[1:]:
        np.testing.assert_allclose(end.displacement, ends[0].displacement, atol=10 * TOLERANCE)
        assert end.force_n[2] == pytest.approx(ends[0].force_n[2], rel=10 * TOLERANCE)


def test_friction_converges_with_the_step() -> None:
    """The way is remembered with an error that vanishes with the step."""
    # Fails with points that stick anchored anew at each step.
    motion = {"depth_mm": 0.6, "shear_mm": [0.1, 0.0], "steps": 2}

    def pull(h: float) -> float:
        posed = scene(friction=0.8, motion=motion, numerics={"max_step_mm": h})
        return simulate(posed, MESH).states[-1].force_n[0]

    coarse, middle, fine = pull(0.2), pull(0.05), pull(0.0125)
    # First order: steps of 0.2, 0.05 and 0.0125 mm, of which 0.05 has a fifth of the error of 0.2; half leaves room.
    assert abs(middle - fine) < 0.5 * abs(coarse - fine)
    assert coarse == pytest.approx(fine, rel=0.02)


def test_correction_passes_take_penetration_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """Soft and stiff penalty agree better with the passes than without."""
    motion = {"depth_mm": 0.6, "steps": 1}

    def press(penalty: float) -> tuple[float, float]:
        last = simulate(scene(motion=motion, numerics={"penalty": penalty}), MESH).states[-1]
        return last.force_n[2], last.max_penetration_mm

    (soft, deep), (hard, _) = press(10.0), press(200.0)
    monkeypatch.setattr(stepping, "PASSES", 0)
    (soft_alone, deep_alone), (hard_alone, _) = press(10.0), press(200.0)
    assert deep < 0.5 * deep_alone
    assert abs(hard - soft) < 0.5 * abs(hard_alone - soft_alone)


def test_scipy_and_pardiso_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    if not linear.has_pardiso():
        pytest.skip("pypardiso is not installed: SciPy is all there is")
    for friction in (0.0, 0.4):
        monkeypatch.undo()
        fast = simulate(gentle(friction=friction), MESH).states[-1]
        monkeypatch.setattr(linear, "has_pardiso", lambda: False)
        slow = simulate(gentle(friction=friction), MESH).states[-1]
        # Two solvers differ by rounding, which Newton's loose way stations (1e-3) may let grow to 1e-6.
        np.testing.assert_allclose(slow.force_n, fast.force_n, rtol=10 * TOLERANCE, atol=1e-8)
        np.testing.assert_allclose(slow.displacement, fast.displacement, atol=10 * TOLERANCE)


def test_a_body_that_passes_through_fails_with_a_reason() -> None:
    """A needle between the contact points touches none of them; without the check it ended "complete" with no force."""
    size = (8.0, 6.0, 2.5)
    posed = scene(
        size,
        indenter={"shape": "sphere", "radius_mm": 0.1},
        motion={"depth_mm": 0.5, "steps": 2, "position_mm": (0.3, 0.2)},
    )
    result = simulate(posed, brick(size, (6, 5, 2)))
    assert result.status == "failed"
    assert "touches no contact point" in result.reason
