"""Whole trajectories: equilibrium of forces, symmetry, scaling, independence of numerics, and honest failure."""

from functools import cache

import numpy as np
import pytest
from pads import DRAG, MIXED, PUNCH, SPHERE, brick, gentle, same, scene

import synth.simulate.linear as linear
import synth.simulate.pattern as pattern
import synth.simulate.stepping as stepping
from synth.arrays import FloatArray
from synth.errors import InputError
from synth.simulate import Trajectory, simulate
from synth.simulate.solve import check_shared

MESH = brick()
TOLERANCE = 1e-6
each = pytest.mark.parametrize("element", MIXED)


@cache
def dragged(element: str = "p1p1") -> Trajectory:
    return simulate(gentle(numerics={"element": element}), MESH)


@each
def test_records_what_was_asked(element: str) -> None:
    result = dragged(element)
    assert (result.status, result.reason) == ("complete", "")
    assert len(result.states) == DRAG["steps"] + 1
    rest, last = result.states[0], result.states[-1]
    assert not rest.displacement.any()
    assert rest.force_n == (0.0, 0.0, 0.0)
    assert (last.depth_mm, last.shear_mm, last.twist_deg) == (0.6, pytest.approx((0.8, -0.3)), pytest.approx(10.0))
    assert result.space.mesh is MESH
    assert result.space.element.name == element
    for state in result.states:
        assert state.displacement.shape == result.space.points.shape
        assert state.traction.shape == (len(result.space.surface_nodes), 3)
    for state in result.states[1:]:
        assert state.residual <= TOLERANCE
        assert 0 < state.min_jacobian < 1
        assert state.newton_iterations > 0
        assert state.force_n[2] > 0  # a press pushes the gel toward the camera
        assert 0 <= state.max_penetration_mm < 0.1
        assert not state.displacement[result.space.held].any()


@each
@pytest.mark.parametrize("indenter", [SPHERE, PUNCH])
@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_centred_press_is_mirror_symmetric(indenter: dict, friction: float, element: str) -> None:
    motion = {"depth_mm": 0.8, "steps": 2}
    result = simulate(scene(indenter=indenter, friction=friction, motion=motion, numerics={"element": element}), MESH)
    last, points = result.states[-1], result.space.points
    fx, fy, fz = last.force_n
    # The mesh is its own mirror image; Newton stops at 1e-6 of the forces, and usually far below.
    assert max(abs(fx), abs(fy)) < TOLERANCE * fz
    assert np.abs(last.torque_nmm).max() < 10 * TOLERANCE * fz
    for axis in (0, 1):
        sign = np.ones(3)
        sign[axis] = -1
        image = {tuple(np.round(x, 6) + 0.0): u for x, u in zip(points * sign, last.displacement * sign, strict=True)}
        mirrored = np.array([image[tuple(np.round(x, 6) + 0.0)] for x in points])
        np.testing.assert_allclose(mirrored, last.displacement, atol=10 * TOLERANCE)


def test_mirrored_motion_gives_the_mirrored_state() -> None:
    motion = {**DRAG, "shear_mm": [-0.8, -0.3], "twist_deg": -10.0, "position_mm": [-0.4, 0.2]}
    one, other = dragged().states[-1], simulate(gentle(motion=motion), MESH).states[-1]
    # Newton stops at 1e-6 on every step, and with 1e-3 between the records, whose errors friction remembers.
    np.testing.assert_allclose(other.force_n, np.array(one.force_n) * [-1, 1, 1], rtol=2e-3)
    np.testing.assert_allclose(other.torque_nmm, np.array(one.torque_nmm) * [1, -1, -1], rtol=2e-3, atol=1e-3)


def test_youngs_modulus_scales_forces_only() -> None:
    hard = simulate(gentle(gel={"youngs_modulus_kpa": 200e3}), MESH)
    for s, t in zip(dragged().states, hard.states, strict=True):
        assert (s.displacement == t.displacement).all()
        np.testing.assert_allclose(t.force_n, 1000 * np.array(s.force_n), rtol=1e-14)
        np.testing.assert_allclose(t.torque_nmm, 1000 * np.array(s.torque_nmm), rtol=1e-14)
        np.testing.assert_allclose(t.traction, 1000 * s.traction, rtol=1e-14)
        assert (s.residual, s.newton_iterations) == (t.residual, t.newton_iterations)


def test_layers_whose_moduli_differ_alike_deform_alike() -> None:
    """Deformation depends on ratios of moduli only, so that such scenes may share a batch."""
    film = {"thickness_mm": 1.0, "youngs_modulus_kpa": 600.0}
    soft = gentle(gel={"layers": [film]})
    hard = gentle(gel={"youngs_modulus_kpa": 400.0, "layers": [{**film, "youngs_modulus_kpa": 1200.0}]})
    check_shared([soft, hard], MESH)
    for s, t in zip(*(simulate(posed, MESH).states for posed in (soft, hard)), strict=True):
        assert (s.displacement == t.displacement).all()
        assert t.force_n == pytest.approx([2 * value for value in s.force_n], rel=1e-12)


def test_the_mesh_must_be_of_the_scenes_pad() -> None:
    with pytest.raises(InputError, match=r"the mesh is of a .* mm pad, the scene's is a"):
        simulate(scene((8.0, 6.0, 3.0)), MESH)


@pytest.mark.parametrize(("asked", "meant"), [("p1p1", "p1p1"), ("auto", "p2p1")])
def test_a_second_call_is_bitwise_the_same_and_auto_is_quadratic(asked: str, meant: str) -> None:
    assert same(simulate(gentle(numerics={"element": asked}), MESH), dragged(meant))


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


@each
def test_slides_off_the_pad(element: str) -> None:
    """Once the indenter has left, the gel springs back: only rounding is left, which is equilibrium."""
    motion = {"depth_mm": 0.3, "shear_mm": [6.0, 0.0], "position_mm": [3.0, 0.0], "steps": 6}
    ball = {"shape": "sphere", "radius_mm": 2.0}
    posed = scene(indenter=ball, friction=0.1, motion=motion, numerics={"element": element})
    result = simulate(posed, MESH)
    assert (result.status, result.reason) == ("complete", "")
    assert result.states[1].force_n[2] > 1e-3
    assert np.abs(result.states[-1].displacement).max() < 1e-9
    assert np.abs(result.states[-1].force_n).max() < 1e-9


@each
def test_release_gives_the_undeformed_pad_back(element: str) -> None:
    motion = {**DRAG, "then": [{"depth_mm": 0.0, "shear_mm": [0.8, -0.3], "twist_deg": 10.0}], "steps": 3}
    result = simulate(gentle(motion=motion, numerics={"element": element}), MESH)
    assert (result.status, len(result.states)) == ("complete", 4)
    assert result.states[2].force_n[2] > 1e-2
    last = result.states[-1]
    # The tolerance is 1e-6 of a force that counts as 1e-6 E mm² at least.
    assert np.abs(last.force_n).max() < 1e-9
    assert np.abs(last.displacement).max() < 1e-9
    assert last.slip_ratio == 0.0


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
    assert "did not converge" in result.reason
    assert 1 < len(result.states) < 9
    for state in result.states:
        assert state.residual <= TOLERANCE
        assert state.min_jacobian > 0
        assert np.isfinite(state.displacement).all()
        assert 0 <= state.force_n[2] < 20.0  # N; a pad squeezed flat by a whole ball takes some 40


class Broken:
    """A factor that refuses, gives NaN, or nonsense."""

    made = 0

    def __init__(self, how: str) -> None:
        self.how = how

    def factorise(self, values: FloatArray) -> bool:
        return self.how != "refuses"

    def apply(self, right: FloatArray) -> FloatArray:
        return np.full_like(right, np.nan if self.how == "nan" else 1e3)


@pytest.mark.parametrize("how", ["refuses", "nan", "nonsense"])
def test_a_solver_that_fails_is_a_failed_trajectory(monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    monkeypatch.setattr(pattern, "_CACHED", type(pattern._CACHED)())
    monkeypatch.setattr(pattern, "direct_factor", lambda *_: Broken(how))
    result = simulate(gentle(), brick(counts=(2, 2, 1)))
    assert result.status == "failed"
    assert len(result.states) == 1
    assert "did not converge" in result.reason


@each
def test_step_length_does_not_change_a_press_without_friction(element: str) -> None:
    motion = {"depth_mm": 0.8, "steps": 2}
    steps = (0.4, 0.25, 0.05)
    ends = [
        simulate(scene(motion=motion, numerics={"max_step_mm": h, "element": element}), MESH).states[-1] for h in steps
    ]
    for end in ends[1:]:
        np.testing.assert_allclose(end.displacement, ends[0].displacement, atol=10 * TOLERANCE)
        assert end.force_n[2] == pytest.approx(ends[0].force_n[2], rel=10 * TOLERANCE)


@each
def test_correction_passes_take_penetration_away(monkeypatch: pytest.MonkeyPatch, element: str) -> None:
    """Soft and stiff penalty agree better with the passes than without."""
    motion = {"depth_mm": 0.6, "steps": 1}

    def press(penalty: float) -> tuple[float, float]:
        numerics = {"penalty": penalty, "element": element}
        last = simulate(scene(motion=motion, numerics=numerics), MESH).states[-1]
        return last.force_n[2], last.max_penetration_mm

    (soft, deep), (hard, _) = press(10.0), press(200.0)
    monkeypatch.setattr(stepping, "PENETRATION", np.inf)
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
        monkeypatch.setattr(pattern, "_CACHED", type(pattern._CACHED)())
        slow = simulate(gentle(friction=friction), MESH).states[-1]
        # Two solvers differ by rounding, which Newton's intermediate steps (1e-3) may let grow to 1e-3 with friction,
        # which remembers, and to its tolerance without.
        close = 2e-3 if friction else 10 * TOLERANCE
        np.testing.assert_allclose(slow.force_n, fast.force_n, rtol=close, atol=1e-8)
        np.testing.assert_allclose(slow.displacement, fast.displacement, atol=close)
