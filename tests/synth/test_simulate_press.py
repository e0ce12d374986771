"""Whole trajectories: equilibrium, symmetry, scaling, independence of axes, paths and numerics, and honest failure."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from commands import refused
from pads import DRAG, FILM, MIXED, PUNCH, SIZE, SPHERE, brick, complete, gentle, pad, same, scene

import synth.simulate.linear as linear
import synth.simulate.pattern as pattern
from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.scene import Scene
from synth.simulate import Trajectory, simulate
from synth.simulate.policy import load_steps, multipliers
from synth.simulate.solve import check_shared

MESH = brick()
TOLERANCE = 1e-6
each = pytest.mark.parametrize("element", MIXED)
RING = {"shape": "torus", "radius_mm": 1.2, "tube_mm": 0.8, "rotation_deg": [8.0, 0.0, 0.0]}


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
    motion, numerics = {"depth_mm": 0.8, "steps": 2}, {"element": element, "tolerance": 1e-9}
    result = simulate(scene(indenter=indenter, friction=friction, motion=motion, numerics=numerics), MESH)
    last, points = result.states[-1], result.space.points
    fx, fy, fz = last.force_n
    # The mesh is its own mirror image, so that only what the solver leaves is not symmetric. Multipliers begin with a
    # state that errs by 20 tolerances of the nodal forces, whose norm is 0.3 fz, and equilibrium with them forgets
    # nothing of it. A residual r changes fx by s·r; |s|, from the adjoint system, is up to 31 (a punch without
    # friction), and each of two updates took its share up to seven times: 20 · 0.3 · 31 · 7² = 9e3 tolerances at most
    # (70 were seen). Friction remembers besides what intermediate steps leave, 1e-3 whatever the tolerance: 5e-8 seen.
    assert max(abs(fx), abs(fy)) < 1e-5 * fz
    assert np.abs(last.torque_nmm).max() < 1e-5 * fz  # arms are up to 2 mm, and moments cancel as forces do
    for axis in (0, 1):
        sign = np.ones(3)
        sign[axis] = -1
        image = {tuple(np.round(x, 6) + 0.0): u for x, u in zip(points * sign, last.displacement * sign, strict=True)}
        mirrored = np.array([image[tuple(np.round(x, 6) + 0.0)] for x in points])
        # A residual moves a node by at most 24 mm times its relative size: 24 · 20 · 7² tolerances.
        np.testing.assert_allclose(mirrored, last.displacement, atol=3e-5)


def test_mirrored_motion_gives_the_mirrored_state_on_a_mesh_of_the_scenes_pad() -> None:
    motion = {**DRAG, "shear_mm": [-0.8, -0.3], "twist_deg": -10.0, "position_mm": [-0.4, 0.2]}
    one, other = dragged().states[-1], simulate(gentle(motion=motion), MESH).states[-1]
    # Newton stops at 1e-6 on every step, and with 1e-3 between the records, whose errors friction remembers.
    np.testing.assert_allclose(other.force_n, np.array(one.force_n) * [-1, 1, 1], rtol=2e-3)
    np.testing.assert_allclose(other.torque_nmm, np.array(one.torque_nmm) * [1, -1, -1], rtol=2e-3, atol=1e-3)
    refused(r"the mesh is of a .* mm pad, the scene's is a", simulate, scene((8.0, 6.0, 3.0)), MESH)
    refused(r"the mesh has 0 layers over the gel, the scene's has 1", simulate, scene(gel={"layers": [FILM]}), MESH)


@pytest.mark.parametrize("layers", [0, 1])
def test_youngs_moduli_that_differ_alike_scale_forces_only(layers: int) -> None:
    """Deformation depends on ratios of moduli only, so that such scenes may share a batch."""

    def gel(kpa: float) -> dict[str, Any]:
        return {"youngs_modulus_kpa": kpa, "layers": layers * [{**FILM, "youngs_modulus_kpa": 3 * kpa}]}

    mesh, soft, hard = pad(layers > 0), gentle(gel=gel(200.0)), gentle(gel=gel(200e3))
    check_shared([soft, hard], mesh)
    for s, t in zip(*(simulate(posed, mesh).states for posed in (soft, hard)), strict=True):
        assert (s.displacement == t.displacement).all()
        np.testing.assert_allclose(t.force_n, 1000 * np.array(s.force_n), rtol=1e-12)
        np.testing.assert_allclose(t.torque_nmm, 1000 * np.array(s.torque_nmm), rtol=1e-12)
        np.testing.assert_allclose(t.traction, 1000 * s.traction, rtol=1e-12)
        assert (s.residual, s.newton_iterations) == (t.residual, t.newton_iterations)


@pytest.mark.parametrize(("asked", "meant"), [("p1p1", "p1p1"), ("auto", "p2p1")])
def test_a_second_call_is_bitwise_the_same_and_auto_is_quadratic(asked: str, meant: str) -> None:
    assert same(simulate(gentle(numerics={"element": asked}), MESH), dragged(meant))


def test_what_touches_nothing_leaves_the_pad_and_above_it_needs_no_solve(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object) -> None:
        raise AssertionError("solved")

    ring = {"shape": "torus", "radius_mm": 9.0, "tube_mm": 0.5}  # around the pad
    for depth, body in ((0.6, ring), (-0.5, SPHERE), (0.0, SPHERE)):
        if depth <= 0:
            monkeypatch.setattr(load_steps, "solve", never)
        result = simulate(gentle(indenter=body, motion={**DRAG, "depth_mm": depth}), MESH)
        assert (result.status, len(result.states)) == ("complete", 5)
        fields = [field for state in result.states for field in (state.displacement, state.traction, state.force_n)]
        assert not any(np.any(field) for field in fields)
        assert result.states[-1].depth_mm == depth
        assert result.states[-1].shear_mm == pytest.approx((0.8, -0.3))


RELEASE = {**DRAG, "then": [{"depth_mm": 0.0, "shear_mm": [0.8, -0.3], "twist_deg": 10.0}], "steps": 3}
SLIDE_OFF = {"depth_mm": 0.3, "shear_mm": [6.0, 0.0], "position_mm": [3.0, 0.0], "steps": 6}


@each
@pytest.mark.parametrize(("motion", "radius", "friction"), [(RELEASE, 3.0, 0.4), (SLIDE_OFF, 2.0, 0.1)])
def test_released_or_slid_off_the_pad_is_as_before(motion: dict, radius: float, friction: float, element: str) -> None:
    """Once the indenter has left, the gel springs back: only rounding is left, which is equilibrium."""
    ball = {"shape": "sphere", "radius_mm": radius}
    posed = scene(indenter=ball, friction=friction, motion=motion, numerics={"element": element})
    states = complete(posed, MESH).states
    assert len(states) == motion["steps"] + 1
    assert states[1].force_n[2] > 1e-3
    # The tolerance is 1e-6 of a force that counts as 1e-6 E mm² at least.
    assert np.abs(states[-1].displacement).max() < 1e-9
    assert np.abs(states[-1].force_n).max() < 1e-9
    assert states[-1].slip_ratio == 0.0


def test_hopeless_press_ends_honestly() -> None:
    """A ring of thin wire pressed through four fifths of a pad whose faces are three times as wide as the wire."""
    wire, motion = {"shape": "torus", "radius_mm": 1.5, "tube_mm": 0.3}, {"depth_mm": 3.3, "steps": 8}
    result = simulate(scene(indenter=wire, friction=0.2, motion=motion, numerics={"edge_length_mm": 0.1}), MESH)
    assert result.status == "partial"
    assert "did not converge" in result.reason
    assert 1 < len(result.states) < 9
    for state in result.states:
        assert state.residual <= TOLERANCE
        assert state.min_jacobian > 0
        assert np.isfinite(state.displacement).all()
        assert 0 <= state.force_n[2] < 20.0  # N; a pad squeezed flat by a whole ball takes some 40


class Broken:
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
    assert (result.status, len(result.states)) == ("failed", 1)
    assert "did not converge" in result.reason


@each
def test_correction_passes_take_penetration_away(monkeypatch: pytest.MonkeyPatch, element: str) -> None:
    """Soft and stiff penalty agree better with the passes than without."""
    motion = {"depth_mm": 0.6, "steps": 1}

    def press(penalty: float) -> tuple[float, float]:
        numerics = {"penalty": penalty, "element": element}
        last = simulate(scene(motion=motion, numerics=numerics), MESH).states[-1]
        return last.force_n[2], last.max_penetration_mm

    (soft, deep), (hard, _) = press(10.0), press(200.0)
    monkeypatch.setattr(multipliers, "PENETRATION", np.inf)
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
        # Rounding grows to Newton's intermediate tolerance (1e-3) with friction, which remembers, else to the last one.
        close = 2e-3 if friction else 10 * TOLERANCE
        np.testing.assert_allclose(slow.force_n, fast.force_n, rtol=close, atol=1e-8)
        np.testing.assert_allclose(slow.displacement, fast.displacement, atol=close)


def case(element: str, friction: float, motion: dict, size: tuple = SIZE, **parts: object) -> Scene:
    gel = {"poisson_ratio": 0.4999, "stiffening": (0.05, 0.0), "layers": [{**FILM, "poisson_ratio": 0.5}]}
    numerics = {"element": element, "tolerance": 1e-8, "max_step_mm": 0.1, "edge_length_mm": None}
    return scene(size, gel=gel, friction=friction, motion=motion, numerics=numerics, **parts)


@pytest.mark.parametrize("element", MIXED)
def test_turned_pad_and_motion_turn_the_answer(element: str) -> None:
    """Frame indifference: mesh, place, shear and indenter turned by 90 degrees about z turn displacement and forces."""
    motion = {"depth_mm": 0.6, "shear_mm": [0.4, -0.2], "twist_deg": 15.0, "position_mm": [0.5, 0.3], "steps": 3}
    turned = {**motion, "shear_mm": [0.2, 0.4], "position_mm": [-0.3, 0.5]}
    mesh = pad(layers=True)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    across = (SIZE[1], SIZE[0], SIZE[2])
    other = PadMesh(mesh.points @ turn.T, mesh.tets, across, mesh.layer)
    tilted = {**RING, "rotation_deg": [8.0, 0.0, 90.0]}
    one = complete(case(element, 0.4, motion, indenter=RING), mesh)
    two = complete(case(element, 0.4, turned, across, indenter=tilted), other)
    np.testing.assert_allclose(two.space.points, one.space.points @ turn.T, atol=1e-14)
    for a, b in zip(one.states[1:], two.states[1:], strict=True):
        # Newton stops at 1e-8 where states are recorded and at 1e-3 between, whose errors friction remembers: they are
        # the same in both but for rounding, unless a point near its limit falls on the other side of it.
        np.testing.assert_allclose(b.displacement, a.displacement @ turn.T, atol=1e-6)
        np.testing.assert_allclose(b.force_n, turn @ a.force_n, atol=1e-6)
        np.testing.assert_allclose(b.torque_nmm, turn @ a.torque_nmm, atol=1e-5)
        assert np.linalg.norm(a.force_n[:2]) > 0.01


@pytest.mark.parametrize("indenter", [SPHERE, RING])
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
