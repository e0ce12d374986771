"""`synth stress`: its check sees what is wrong, the processes are watched, and shipped expectations make sense."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from commands import refused
from pads import brick

from synth.errors import InputError
from synth.mesh.element import p2p1
from synth.scene.template import load_scene
from synth.simulate.space import function_space
from synth.stress.cases import EXTREME, Case, Deviation, Run, all_runs, compared, load_expectations, selected
from synth.stress.check import GAUSS, Result, evaluate, faults, measured, smallest_jacobian
from synth.stress.suite import result_of, run_stress
from synth.stress.worker import write_surface

MESH = brick()
STRETCH = np.diag([0.9, 0.95, 1.1])  # A deformation that any check must pass: det F = 0.94
FIRST, *OTHERS = MESH.tets[0]
BEYOND = 2 * (MESH.points[OTHERS].mean(axis=0) - MESH.points[FIRST])  # Turns the first tetrahedron over


def run(**fields: Any) -> Run:
    case = Case.model_validate({"name": "a", "group": "g", "why": "w", "outcome": ["complete"], **fields})
    return Run(case, "p1p1", case.budget_s or 60.0, EXTREME / "base.toml")


def state(**fields: Any) -> dict[str, Any]:
    return {
        "depth_mm": 0.4, "shear_mm": [0.0, 0.0], "twist_deg": 0.0, "force_n": [0.3, 0.4, 1.0], "torque_nmm": [0.0] * 3,
        "converged": True, "newton_iterations": 5, "residual": 1e-7, "min_jacobian": 0.94, "max_penetration_mm": 0.01,
        **fields,
    }  # fmt: skip


def result(asked: Run | None = None, outcome: str = "complete", message: str = "", **changes: Any) -> Result:
    """A sound result of two states; changes: last (fields of its last state), record, displacement."""
    stretched = MESH.points @ (STRETCH - np.eye(3))
    displacement = np.array([0 * stretched, changes.get("displacement", stretched)])
    last = state(**changes.get("last", {}))
    states = [state(residual=0.0, min_jacobian=1.0, force_n=[0.0] * 3), last]
    record = {"states": states, "states_asked": 2, "tolerance": 1e-6, "mesh": MESH.hash, **changes.get("record", {})}
    arrays = {
        "displacement": displacement, "traction": np.zeros((2, 5, 3)), "points": MESH.points, "nodes": MESH.tets,
    }  # fmt: skip
    return Result(asked or run(), outcome, message, 1.0, record, arrays)


def moved(node: int, by: Any) -> np.ndarray:
    displacement = np.zeros_like(MESH.points)
    displacement[node] = by
    return displacement


def test_sound_results_are_as_expected_and_deviations_accepted_only_as_noted() -> None:
    verdict = evaluate(result(), {})
    assert (verdict.broken, verdict.word, verdict.ok) == ((), "as expected", True)
    worse = state(max_penetration_mm=0.5, residual=9e-7, min_jacobian=0.1, newton_iterations=7)
    record = {"states": [state(), worse, state()]}
    found = measured(result(record=record))
    assert (found["penetration_mm"], found["residual"], found["min_jacobian"]) == (0.5, 9e-7, 0.1)
    assert (found["iterations"], found["states"], found["force_z_n"]) == (17, 2, 1.0)
    assert found["side_ratio"] == pytest.approx(0.5)
    entry: dict[str, Any] = {"bounds": {"force_z_n": [2, 3]}, "deviation": {"outcome": ["complete"], "because": "b"}}
    verdict = evaluate(result(run(**entry)), {})
    assert (verdict.ok, verdict.deviates, verdict.word) == (True, True, "explained")
    entry["deviation"]["bounds"] = {"force_z_n": [4, 5]}
    verdict = evaluate(result(run(**entry)), {})
    assert (verdict.ok, verdict.deviates) == (False, False)
    assert "[2, 3]" in verdict.broken[0]  # what was expected first, not the excuse
    entry["bounds"] = {"force_z_n": [0, 1]}
    assert evaluate(result(run(**entry)), {}).word == "as expected"
    with pytest.raises(ValueError, match="because"):
        Deviation.model_validate({"outcome": ["complete"]})


@pytest.mark.parametrize(("wrong", "message"), [
    ({"displacement": moved(7, np.nan)}, "state 1: a field is not finite"),
    ({"last": {"force_n": [0.0, float("nan"), 1.0]}}, "state 1: force_n is not finite"),
    ({"last": {"residual": 2e-6}}, "residual 2e-06 is above the tolerance 1e-06"),
    ({"last": {"residual": float("nan")}}, "residual is not finite"),
    ({"last": {"min_jacobian": 0.0}}, "smallest det F is 0"),
    ({"displacement": moved(FIRST, BEYOND)}, "det F of the stored displacements is -"),
    ({"record": {"states_asked": 3}}, "complete with 2 of 3 states"),
    ({"outcome": "partial", "message": "why", "record": {"states_asked": 2}}, "partial with 2 of 2 states"),
    ({"outcome": "partial", "record": {"states_asked": 3}}, "partial without a reason"),
    ({"outcome": "hung"}, "hung: killed after its budget of 60 s"),
    ({"outcome": "crashed", "message": "exit status 1"}, "crashed: exit status 1"),
])  # fmt: skip
def test_no_result_may(wrong: dict[str, Any], message: str) -> None:
    lenient = {"outcome": ["complete", "partial"], "deviation": {"outcome": ["complete", "partial"], "because": "b"}}
    verdict = evaluate(result(run(**lenient), **wrong), {})
    assert any(message in text for text in verdict.broken), verdict.broken
    assert not verdict.ok


@pytest.mark.parametrize(("entry", "ended", "message"), [
    ({"outcome": ["partial"]}, {}, "complete, expected partial"),
    ({"says": "too small"}, {"outcome": "failed", "message": "no"}, "does not say 'too small'"),
    ({"bounds": {"force_z_n": [0.1, 0.9]}}, {}, "force_z_n = 1 is not within [0.1, 0.9]"),
    ({"bounds": {"weight": [0, 1]}}, {}, "weight is not measured"),
    ({"compare": {"with": "b", "force_ratio": [1.1, 2]}}, {}, "force 1 N is 1 of b's"),
    ({"compare": {"with": "b", "displacement": 1e-9}}, {"displacement": 0 * MESH.points}, "differs from b's by 1"),
    ({"compare": {"with": "b", "displacement": 1}}, {"record": {"mesh": "other"}}, "another mesh"),
    ({"compare": {"with": "c", "displacement": 1}}, {}, "cannot be compared with c, which was not run"),
])  # fmt: skip
def test_expectations_are_compared(entry: dict[str, Any], ended: dict[str, Any], message: str) -> None:
    verdict = evaluate(result(run(**entry), **ended), {"b": result()})
    assert any(message in text for text in verdict.broken), verdict.broken


def test_jacobian_of_elements_and_one_folded_at_a_corner_is_held_against_any_state() -> None:
    """An affine map has det F everywhere; u_x = c x^2 has 1 + 2 c x."""
    space = function_space(MESH, p2p1())
    places = np.concatenate([np.eye(4), GAUSS])
    for points, nodes in ((MESH.points, MESH.tets), (space.points, space.nodes)):
        affine = points @ (STRETCH - np.eye(3))
        # Rounding of 3 x 3 determinants of order 1.
        assert smallest_jacobian(points, nodes, affine, places) == pytest.approx(np.linalg.det(STRETCH), abs=1e-13)
    square = space.points**2 * (0.1, 0, 0)
    at_corners = smallest_jacobian(space.points, space.nodes, square, np.eye(4))
    assert at_corners == pytest.approx(1 + 0.2 * MESH.points[:, 0].min(), abs=1e-13)
    lowest = min(float((place @ MESH.points[MESH.tets][:, :, 0].T).min()) for place in GAUSS)
    assert smallest_jacobian(space.points, space.nodes, square, GAUSS) == pytest.approx(1 + 0.2 * lowest, abs=1e-13)
    square[0] = np.nan
    assert np.isnan(smallest_jacobian(space.points, space.nodes, square, places))
    # 1 + 2 c x changes sign between the corner at x = -4 and the nearest integration point at -3.72 (b = 0.138).
    square = space.points**2 * (1 / (2 * 3.85), 0, 0)
    for fields in ((0 * square, square), (square, 0 * square)):
        sound = result()
        arrays = {**sound.arrays, "points": space.points, "nodes": space.nodes, "displacement": np.array(fields)}
        bent = replace(sound, arrays=arrays)
        assert faults(bent) == []
        assert any("corner_jacobian = -0.03" in text for text in evaluate(bent, {}).broken)  # 1 - 4 / 3.85
        excused = {"outcome": ["complete"], "because": "b", "bounds": {"corner_jacobian": [-0.1, 1.0]}}
        assert evaluate(replace(bent, run=run(deviation=excused)), {}).word == "explained"


@pytest.mark.parametrize(("script", "budget", "outcome", "message"), [
    ("import time; time.sleep(60)", 0.7, "hung", ""),
    ("raise RuntimeError('boom')", 30, "crashed", "exit status 1: RuntimeError: boom"),
    ("import os; os.kill(os.getpid(), 11)", 30, "crashed", "signal 11"),
    ("pass", 30, "crashed", "exit status 0: it said nothing"),
    ("import sys; open(sys.argv[1] + '/result.json', 'w').write('{}'); sys.exit(3)", 30, "crashed", "status 3"),
])  # fmt: skip
def test_processes_are_watched(tmp_path: Path, script: str, budget: float, outcome: str, message: str) -> None:
    asked = replace(run(), budget_s=budget)
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "run.json").write_text('{"element": "p1p1"}')
    (tmp_path / "case" / "result.json").write_text("{}")  # of an earlier run: must not count
    found = result_of(asked, tmp_path / "case", tmp_path, (sys.executable, "-c", script))
    assert (found.outcome, found.wall_s < 25) == (outcome, True)
    assert message in found.message
    assert not evaluate(found, {}).ok


COARSE = '"numerics.edge_length_mm=2.0", "motion.depth_mm=0.3", "motion.steps=1"'
SUITE = f"""
elements = ["p1p1"]
budget_s = 60.0
[[case]]
name = "soft"
group = "small"
why = "a press"
outcome = ["complete"]
bounds = {{ force_z_n = [0.05, 0.5], depth_mm = [0.3, 0.3] }}
set = [{COARSE}]
[[case]]
name = "hard"
group = "small"
why = "the same displacement and a tenfold force, which is not what is written down here"
outcome = ["complete"]
compare = {{ with = "soft", displacement = 1e-9, force_ratio = [1.0, 1.1] }}
set = [{COARSE}, "sensor.gel.youngs_modulus_kpa=2000"]
[[case]]
name = "hopeless"
group = "wrong"
why = "a pad of 20 m"
elements = ["auto"]
outcome = ["refused"]
says = "size_mm"
set = ["sensor.gel.size_mm=[20000, 15000, 4000]"]
"""


def test_a_small_suite_end_to_end_and_folders_from_elsewhere_are_not_emptied(tmp_path: Path, capsys) -> None:
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    scenes.mkdir()
    (scenes / "base.toml").write_text((EXTREME / "base.toml").read_text())
    (scenes / "expected.toml").write_text(SUITE)
    assert run_stress(out, None, 2, False, scenes) == 1
    shown, report = capsys.readouterr().out, json.loads((out / "stress.json").read_text())
    found = [(case["case"], case["outcome"], case["ok"]) for case in report["cases"]]
    assert found == [("soft", "complete", True), ("hard", "complete", False), ("hopeless", "refused", True)]
    (broken,) = report["cases"][1]["broken"]  # the displacement is the same; only the force is not
    assert "is 10 of soft's, not within [1, 1.1]" in broken
    assert f"hard-p1p1: OTHERWISE: {broken}" in shown
    assert [case["verdict"] for case in report["cases"]] == ["as expected", "OTHERWISE", "as expected"]
    assert str(tmp_path) not in (out / "stress.json").read_text()  # it is read elsewhere
    assert run_stress(out, ["wrong"], 1, True, scenes) == 0  # Only what is asked for, in place of the first
    report = json.loads(capsys.readouterr().out)
    assert [case["case"] for case in report["cases"]] == ["hopeless"]
    assert json.loads((out / "stress.json").read_text()) == report
    with pytest.raises(InputError, match=r"no case or group of that name; cases are soft, hard, hopeless"):
        run_stress(out, ["nothing"], 1, False, scenes)
    (scenes / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r": exists and does not come from"):
        result_of(run(), scenes, tmp_path)
    assert (scenes / "notes.txt").read_text() == "mine"


def test_shipped_expectations_can_be_met_and_selection_brings_partners_along() -> None:
    """Every case loads, or refuses where it is expected to; what is bounded is measured; comparisons have partners."""
    expectations = load_expectations(EXTREME / "expected.toml")
    runs = all_runs(expectations)
    assert len({one.name for one in runs}) == len(runs) >= 70
    known = set(measured(result(last={"slip_ratio": 1.0})))
    for one in runs:
        case = one.case
        assert set(case.bounds) <= known, case.name
        assert len(compared(one, runs)) >= (case.compare is not None), case.name
        for low, high in case.bounds.values():
            assert low <= high, case.name
        if case.surface is None and case.outcome == ("refused",):
            assert case.says in refused(".", load_scene, one.base, one.assignments)
        else:
            assert load_scene(one.base, one.assignments).corners[0].motion.steps >= 1
    chosen = selected(runs, ["poisson_0.5"])
    names = [one.case.name for one in chosen if one.element == chosen[0].element]
    assert names == ["reference", "poisson_0.499999", "poisson_0.5"]


@pytest.mark.parametrize(("text", "message"), [
    (SUITE.replace('name = "hard"', 'name = "soft"'), "there are two cases 'soft'"),
    (SUITE.replace('with = "soft"', 'with = "sfot"'), "compares with 'sfot', which is none"),
    (SUITE.replace("says =", "say ="), "say: Extra inputs"),
    (SUITE.replace('["refused"]', '["exploded"]'), "outcome.0: Input should be"),
    ("elements = [", "not valid TOML"),
])  # fmt: skip
def test_a_wrong_file_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "expected.toml"
    path.write_text(text)
    said = refused(".", load_expectations, path)
    assert said.startswith(str(path))
    assert message in said


def test_surfaces_are_what_they_are_called(tmp_path: Path) -> None:
    def made(variant: Any) -> Any:
        write_surface(variant, tmp_path / "ball.ply")
        return pv.read(tmp_path / "ball.ply")

    ball = made("ball")
    assert ball.n_open_edges == 0
    turned = made("inside out")
    assert (turned.regular_faces == ball.regular_faces[:, ::-1]).all()
    same = (made("mixed").regular_faces == ball.regular_faces).all(axis=1)
    assert 0.6 < same.mean() < 0.7
    assert made("pane").length == pytest.approx((6**2 + 0.06**2 + 4**2) ** 0.5, rel=1e-6)
    slivers = made("slivers")
    assert slivers.n_open_edges == 0
    assert slivers.n_cells == ball.n_cells + 2 * (ball.n_cells // 10)
    areas = slivers.compute_cell_sizes()["Area"]
    assert areas.min() < 1e-4 * np.median(areas)
    assert made("open").n_open_edges > 0
    assert made("metres").length < 0.02
