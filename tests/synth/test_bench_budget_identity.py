"""What the study of the error budget takes for the same press: the same draw, solver and mesh, whatever chose it."""

import ast
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_scene import TEXT, write_tiny

from synth.bench import budget_study
from synth.bench.budget_study import REFERENCE, Reference, Study, drawn
from synth.scene.template import load_scene

ROOT = Path(__file__).parents[2]


def test_a_changed_choice_keeps_what_was_pressed(tmp_path: Path) -> None:
    """Rungs are known by their meshes, references also where a coarser one would do.

    Fails with only the coarsest reference that will do known again, and with any mesh taken.
    """
    text = TEXT.replace("edge_length_mm = 1.25", "target_error_px = 0.0065").replace("steps = 2", "steps = 3")
    template = load_scene(write_tiny(tmp_path, text))
    study = Study((template,), 2, 1, reference=Reference(across=18))
    one = drawn(template, 2, 1)
    assert one.chosen_rung == "6x3"
    coarser, finer = (
        replace(one, chosen=replace(one.chosen, across=across, spacing_mm=factor * one.chosen.spacing_mm))
        for across, factor in ((4, 1.6), (8, 0.7))
    )
    hashes = [
        study.reference.mesh(each.scene.sensor.gel, each.focus, each.chosen.spacing_mm)[0].hash
        for each in (coarser, one, finer)
    ]
    assert len(set(hashes)) == 3
    known = [[study.answered(each, REFERENCE, there) for there in hashes] for each in (coarser, one, finer)]
    assert known == [[True, True, True], [False, True, True], [False, False, True]]
    for each in (coarser, one, finer):
        assert study.answered(each, "4x3", one.mesh("4x3")[0].hash)
        assert not study.answered(each, "4x3", one.mesh("6x3")[0].hash)


def test_the_solver_is_what_presses_on_a_given_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails with one of `CHOOSERS` left out, and with all of `simulate` taken for one."""
    package = tmp_path / "synth"
    for folder in ("mesh", "simulate"):
        shutil.copytree(ROOT / "synth" / folder, package / folder)
    before = budget_study.solver()
    monkeypatch.setattr(budget_study, "__file__", str(package / "bench" / "budget_study.py"))
    assert budget_study.solver() == before
    for name in ("error_model.py", "resolution.py", "shared.py"):
        with (package / "simulate" / name).open("a") as file:
            file.write("# another model\n")
    assert budget_study.solver() == before
    for name in ("simulate/contact.py", "simulate/stepping.py", "mesh/pad.py"):
        text = (package / name).read_text()
        (package / name).write_text(text + "# another solver\n")
        assert budget_study.solver() != before
        (package / name).write_text(text)


def test_choosers_have_no_part_in_a_press() -> None:
    """No module of the solver's imports one of those that choose meshes, so that they cannot change a press.

    Fails with one of `CHOOSERS` left out: it imports another.
    """
    folder = ROOT / "synth" / "simulate"
    chooses = {f"synth.simulate.{Path(name).stem}" for name in budget_study.CHOOSERS}
    for file in folder.glob("*.py"):
        if file.name not in budget_study.CHOOSERS:
            tree = ast.parse(file.read_text(encoding="utf-8"))
            names = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
            names |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
            assert not names & chooses, file.name
