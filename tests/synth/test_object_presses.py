"""Objects pressed: against an analytic body, and by relaxation where Newton's method finds no equilibrium."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from pads import complete, same, scene

from benchmarks.probe import probe
from synth.errors import InputError
from synth.mesh import Counts, Focus, graded_box
from synth.press import indenter
from synth.press.press import Press
from synth.press.scene_path import path_of
from synth.scene import Scene
from synth.scene.template import SCENES
from synth.simulate import simulate
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.pad import prepare
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy import load_steps, multipliers
from synth.simulate.policy.newton import (
    AIM,
    LEAST_VISCOSITY,
    MAX_ERROR,
    MOST_VISCOSITY,
    Solution,
    next_viscosity,
    solve,
)
from synth.simulate.policy.requests import Asking
from synth.simulate.solve import simulate_press
from synth.simulate.trajectory import Trajectory

SIZE = (12.0, 10.0, 3.0)
MESH = graded_box(SIZE, Focus((0.0, 0.0), (2.0, 2.0)), Counts((4, 4), (2, 2), 2))
EDGE, DEPTH = 3.5, 0.6
STRICT = SolverOptions(relaxed_tolerance=0.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    pv.Cube(x_length=EDGE, y_length=EDGE, z_length=EDGE).triangulate().clean().save(tmp_path / "cube.stl")
    return tmp_path


def pressed(body: dict[str, Any]) -> Scene:
    moves = {"depth_mm": DEPTH, "shear_mm": [0.3, 0.2], "twist_deg": 5.0, "steps": 2, "position_mm": [0.1, 0.2]}
    return scene(SIZE, indenter=body, friction=0.5, motion=moves, numerics={"element": "auto"})


def cube(**fields: Any) -> dict[str, Any]:
    return {"shape": "mesh", "file": "cube.stl", **fields}


@pytest.mark.parametrize("turned", [(0.0, 0.0, 0.0), (20.0, 10.0, 30.0)])
def test_a_cube_is_the_block_of_its_fillet(folder: Path, monkeypatch, turned: tuple[float, float, float]) -> None:
    monkeypatch.setattr(indenter, "OBJECT_STIFFNESS", 1.0)  # as that of the block
    monkeypatch.setattr(multipliers, "DEEP", np.inf)  # so that the cube has the passes of the block
    fillet = 0.7  # more than what the mesh asks for, so that both keep it
    block = {"shape": "box", "size_mm": [EDGE, EDGE, EDGE], "fillet_mm": fillet, "rotation_deg": turned}
    exact = simulate(pressed(block), MESH, options=STRICT)
    fine = cube(fillet_mm=fillet, cell_mm=fillet / 7, rotation_deg=turned)
    found = simulate(pressed(fine), MESH, folder, options=STRICT)
    axes = [np.linspace(-length / 2, length / 2, 31) for length in SIZE[:2]]
    face = probe(found.space, np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2))
    for one, other in zip(exact.states[1:], found.states[1:], strict=True):
        error = np.linalg.norm(np.subtract(one.force_n, other.force_n)) / np.linalg.norm(one.force_n)
        assert error < 0.01
        moved = (face @ (other.displacement - one.displacement))[:, :2]
        assert 17.0 * np.sqrt((moved**2).sum(axis=1).mean()) < 0.02  # px of the shipped scene gelsight_mini


def test_a_body_is_no_deeper_in_the_gel_than_allowed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the CPU and by the batched solver, with contacts so soft that updates of the multipliers alone do not do.

    The stiffness of the passes is gone after the record: the last state does not depend on those of the first.
    """
    mesh = graded_box(SIZE, Focus((0.0, 0.0), (2.0, 2.0)), Counts((3, 3), (1, 1), 2))

    def soft(penalty: float, body: dict[str, Any]) -> Press:
        drawn = pressed(body)
        numerics = drawn.numerics.model_copy(update={"penalty": penalty})
        return Press.of(drawn.model_copy(update={"numerics": numerics}), mesh, folder)

    def both(press: Press, frames: frozenset[int] | None = None) -> list[Trajectory]:
        batched = simulate_presses([(press, frames)], prepare(press.scene, mesh, "cpu"))
        return [simulate_press(press, frames), *dict(batched).values()]

    found, allowed = both(soft(4.0, cube())), multipliers.DEEP * DEPTH
    for trajectory, last in zip(found, both(soft(4.0, cube()), frozenset({2})), strict=True):
        assert trajectory.status == "complete"
        assert 0 < max(state.max_penetration_mm for state in trajectory.states) <= allowed
        assert same(replace(last, states=last.states[2:]), replace(trajectory, states=trajectory.states[2:]))
    for one, other in zip(*(trajectory.states[1:] for trajectory in found), strict=True):
        # Intermediate steps have a relaxed tolerance of 1e-3 on the CPU, which friction remembers.
        np.testing.assert_allclose(one.force_n, other.force_n, atol=5e-3 * one.force_n[2])
    for body, share in ((cube(), "2%"), ({"shape": "sphere", "radius_mm": 3.0}, "20%")):
        for trajectory in both(soft(0.05, body)):
            assert f"the gel stays inside the indenter by more than {share} of the depth" in trajectory.reason
    monkeypatch.setattr(multipliers, "MAX_STIFFENING", 1.0)
    assert "the gel stays inside" in simulate_press(soft(4.0, cube())).reason


def test_relaxation_finds_the_equilibrium_of_newtons_method(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In load steps, which have a relaxed tolerance, and in passes, which have a reach."""
    ball = pressed({"shape": "sphere", "radius_mm": 3.0})
    soft = pressed(cube(rotation_deg=[20.0, 10.0, 30.0]))
    soft = soft.model_copy(update={"numerics": soft.numerics.model_copy(update={"penalty": 10.0})})
    for drawn, fails in (
        (ball, lambda tolerance, *rest: tolerance == STANDARD.relaxed_tolerance),
        (soft, lambda *settings: len(settings) == 3),
    ):
        expected = simulate(drawn, MESH, folder)

        def unlucky(*given: Any, fails: Callable[..., bool] = fails) -> Asking[Solution]:
            found = yield from solve(*given)
            return replace(found, converged=False) if fails(*given[1:]) else found

        with monkeypatch.context() as patched:
            patched.setattr(load_steps, "MAX_RELAXED_STEP", 2.0)
            patched.setattr(multipliers, "MAX_RELAXED_UPDATE", 2.0)
            for part in (load_steps, multipliers):
                patched.setattr(part, "solve", unlucky)
            relaxed = complete(drawn, MESH, folder)
        for one, other in zip(expected.states[1:], relaxed.states[1:], strict=True):
            assert one.newton_iterations != other.newton_iterations
            scale = np.abs(one.displacement).max()
            np.testing.assert_allclose(other.displacement, one.displacement, atol=2e-3 * scale)


def test_relaxation_goes_on_where_newtons_method_ends_and_viscosity_follows_the_error(monkeypatch) -> None:
    """A key that lies askew, whose corners slip over the contact points."""
    key = {"shape": "mesh", "file": "key.stl", "size_mm": 8.0, "rotation_deg": [60.0, 35.0, 125.0]}
    moves = {"depth_mm": 0.8, "position_mm": [0.1, 0.2], "shear_mm": [0.6, 0.3], "twist_deg": 5.0, "steps": 2}
    drawn = scene(SIZE, indenter=key, friction=0.3, motion=moves, numerics={"element": "auto"})
    states = complete(drawn, MESH, SCENES / "objects").states
    assert all(state.residual < 1e-5 and state.min_jacobian > 0 for state in states)
    monkeypatch.setattr(load_steps, "MAX_RELAXED_STEP", 0.0)
    monkeypatch.setattr(multipliers, "MAX_RELAXED_UPDATE", 0.0)
    assert simulate(drawn, MESH, SCENES / "objects").status == "partial"
    errors = (AIM, AIM / 2, 0.0, 2 * MAX_ERROR, np.inf)
    same, less, least, more, most = (next_viscosity(1.0, error) for error in errors)
    assert same == pytest.approx(1.0)
    assert least < next_viscosity(1.0, 0.0, refused=True) <= less < same < more <= most
    assert next_viscosity(LEAST_VISCOSITY, 0.0) == 0.0
    assert next_viscosity(MOST_VISCOSITY, np.inf) == MOST_VISCOSITY


def ring_file(folder: Path, hole_mm: float) -> Path:
    file = folder / "ring.stl"
    disc = pv.Disc(inner=hole_mm, outer=hole_mm + 3.0, c_res=128).triangulate()
    disc.extrude((0.0, 0.0, 2.0), capping=True).triangulate().clean().save(file)
    return file


@pytest.mark.parametrize("is_batched", [False, True], ids=["single", "batched"])
def test_a_hole_around_the_gel_touches_nothing_and_is_not_called_too_small(tmp_path: Path, is_batched: bool) -> None:
    size = (4.0, 4.0, 2.0)
    file = ring_file(tmp_path, 3.2)  # the pad's corners are 2.8 mm from its middle
    body = {"shape": "mesh", "file": str(file), "cell_mm": 0.2, "fillet_mm": 0.3}
    around = scene(size, indenter=body, motion={"depth_mm": 0.5, "steps": 1}, numerics={"element": "p1p1"})
    mesh = graded_box(size, Focus((0.0, 0.0), (1.0, 1.0)), Counts((4, 4), (2, 2), 2))
    made = Press.of(around, mesh, tmp_path)
    batched = (
        simulate_presses([(made, None)], prepare(around, mesh, "cpu")) if is_batched else [(0, simulate_press(made))]
    )
    ((_, found),) = batched
    assert found.status == "complete", found.reason
    assert found.states[-1].force_n == (0.0, 0.0, 0.0)


def test_a_body_whose_hole_is_far_wider_than_the_gel_is_named_so(tmp_path: Path) -> None:
    body = {"shape": "mesh", "file": str(ring_file(tmp_path, 9.0))}
    with pytest.raises(InputError, match="only a hole or a hollow of it lies over the gel"):
        path_of(scene((4.0, 4.0, 2.0), indenter=body, motion={"depth_mm": 0.5}))


def test_a_body_that_slips_between_contact_points_is_still_too_small() -> None:
    needle = {"shape": "sphere", "radius_mm": 0.05}
    found = simulate(
        scene(SIZE, indenter=needle, motion={"depth_mm": 0.02, "steps": 1, "position_mm": [5.3, 4.1]}), MESH
    )
    assert "too small for the mesh" in found.reason
