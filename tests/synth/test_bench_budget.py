"""The study of the error budget at work, on presses of a second."""

import csv
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_scene import TEXT, write_tiny

from synth.bench import budget_press, budget_study
from synth.bench.budget import study_budget
from synth.bench.budget_field import picture_errors, places
from synth.bench.budget_pool import presses
from synth.bench.budget_press import press, ready_stepper
from synth.bench.budget_schedule import Schedule
from synth.bench.budget_store import Store
from synth.bench.budget_study import REFERENCE, Job, Reference, Study, drawn, jobs
from synth.cli import main
from synth.errors import InputError
from synth.scene.sampling import draw, pairs_of
from synth.scene.template import load_scene
from synth.simulate import simulate
from synth.simulate.mesh_rule import MeshRule
from synth.simulate.resolution import LADDER, Fineness, Resolution, ladder

ROOT = Path(__file__).parents[2]
TARGET = 0.0065
"""px, such that the first draw is given 4 elements across and the second 6."""
BUDGETED = TEXT.replace("edge_length_mm = 1.25", f"target_error_px = {TARGET}").replace("steps = 2", "steps = 3")
SMALL = Reference(across=8, step_mm=0.1)


@pytest.fixture(scope="module", autouse=True)
def _each_press_once() -> Iterator[None]:
    """Times are not looked at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(budget_press, "SHORT_S", 0.0)
        yield


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    template = load_scene(write_tiny(tmp_path_factory.mktemp("scene"), BUDGETED))
    return Study((template,), 2, 2, (4, 6), SMALL)


@pytest.fixture(scope="module")
def done(study: Study, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with the whole study."""
    out = tmp_path_factory.mktemp("done")
    study_budget(study, out, "the command")
    return out


def test_a_draw_is_that_of_generate(study: Study) -> None:
    template = study.templates[0]
    one = drawn(template, 2, 1)
    assert one.scene == draw(template, 2, 1)
    assert (
        one.chosen.mesh.hash == MeshRule.of(one.scene.numerics).resolution(one.scene, template.source.parent).mesh.hash
    )
    frames = {k for pair in pairs_of(template, 2, 1, one.scene.motion.steps) for k in pair.frames}
    assert one.frames == frames
    assert one.judged == sorted(frames - {0})
    mesh, spacing_mm = one.mesh(one.chosen_rung)
    assert mesh.hash == one.chosen.mesh.hash
    assert one.predicted_px(spacing_mm) == one.chosen.error_px


def test_a_press_is_that_of_generate(study: Study) -> None:
    """To the bit. Fails with corrections dropped after 1 iteration, all frames wanted, and another penalty."""
    one = drawn(study.templates[0], 2, 1)
    assert len(one.judged) < one.scene.motion.steps  # else it says nothing about the frames
    mesh, _ = one.mesh("4x2")
    folder = one.template.source.parent
    theirs = simulate(one.scene, mesh, folder, frames=one.frames)
    ours = ready_stepper(one.scene, mesh, folder, one.frames).run()[0]
    for a, b in zip(theirs.states, ours.states, strict=True):
        assert np.array_equal(a.displacement, b.displacement)
        assert a.max_penetration_mm == b.max_penetration_mm


def test_a_press_that_cannot_be_set_up(study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is kept as such; numbers that there are none of survive the file. Fails with `null` read as it is."""

    def refuse(*_: object) -> None:
        raise InputError("no body")

    monkeypatch.setattr(budget_press, "ready_stepper", refuse)
    with Store(tmp_path, study) as store:
        store.keep(press(study, Job("tiny", 1, "4x2")))
    with Store(tmp_path, study) as store:
        (kept,) = store.measurements.values()
    assert (kept.job, kept.status, kept.reason) == (Job("tiny", 1, "4x2"), "refused", "no body")
    assert np.isnan([kept.seconds, kept.penetration_mm]).all()
    assert list((tmp_path / "fields").iterdir()) == []


def test_a_draw_that_no_attempt_gives(study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = BUDGETED.replace("depth_mm = { uniform = [0.1, 0.3] }", "depth_mm = { normal = [0.2, 1e9] }")
    hopeless = replace(study, templates=(load_scene(write_tiny(tmp_path, text)),))
    with pytest.raises(InputError, match=r"draw 0: none of 10 attempts"):
        drawn(hopeless.templates[0], 2, 0)
    assert study_budget(hopeless, tmp_path / "out", "c") == 1
    assert "none of 2 draws" in capsys.readouterr().out
    assert (tmp_path / "out" / "budget.md").read_text().count("not drawn:") == 2


def test_reference_is_finer_every_way() -> None:
    """Also through the thickness. Fails with as many elements there as `graded_mesh` would have, and with the chosen
    mesh's own spacing asked of it.
    """
    template = load_scene("gelsight")
    whole = Study((template,), 2, 20)
    for index in (3, 12):  # the smallest and the largest contact of the first twenty
        one = drawn(template, 2, index)
        mesh, fine = Reference().mesh(one.scene.sensor.gel, one.focus, one.chosen.spacing_mm)
        finest, spacing_mm = one.mesh(whole.rungs(one)[-1])
        assert fine < spacing_mm
        number = Reference().across_of(one.scene.sensor.gel, one.focus, one.chosen.spacing_mm)
        assert 2.4 * fine <= one.chosen.spacing_mm < 2.4 * fine * number / (number - 2)
        assert Reference(across=8).across_of(one.scene.sensor.gel, one.focus, one.chosen.spacing_mm) == 8
        planes, theirs = (np.unique(m.points[:, 2]) for m in (mesh, finest))
        assert len(planes) > len(theirs)
        assert planes[1] < 1.01 * fine
        heights = np.diff(planes)
        # With one element more than a growth of 2.2 asks for, 1 + q + ... + q^n = 1 + ... + 2.2^(n - 1): q < 1.8 from
        # three elements on.
        assert (heights[1:] / heights[:-1]).max() < 1.8
    assert Reference().correction_iterations == 20


def test_rungs_and_order_of_work(study: Study) -> None:
    """Fails with one rung beyond the chosen one, with rungs finer than the reference, and with the ladder first."""
    whole = replace(study, across=LADDER, reference=replace(SMALL, across=14))
    draws = [drawn(study.templates[0], 2, index) for index in range(2)]
    assert [one.chosen.across for one in draws] == [4, 6]
    names = [str(fineness) for fineness in ladder(draws[0].scene.sensor.gel, draws[0].focus)]
    for place, fineness in enumerate(map(Fineness.of, names)):
        spacing_mm = draws[0].mesh(str(fineness))[1]
        chosen = Resolution(draws[0].chosen.mesh, fineness.across, fineness.through, spacing_mm, 0.0)
        found = whole.rungs(replace(draws[0], chosen=chosen))
        finest = whole.reference.across_of(draws[0].scene.sensor.gel, draws[0].focus, spacing_mm)
        coarser = [name for name in names[: place + 4] if Fineness.of(name).across < finest]
        assert found == (coarser if str(fineness) in coarser else [*coarser, str(fineness)])
        assert finest <= 14
    every = list(jobs(whole, draws))
    assert [job.rung for job in every[:2]] == [REFERENCE, REFERENCE]
    sizes = [len(draws[job.index].mesh(job.rung)[0].points) for job in every[2:]]
    assert sizes[0] > 3 * sizes[-1]  # by work, in which the length of the path counts, too


def test_the_whole_study(done: Path, study: Study, capsys: pytest.CaptureFixture[str]) -> None:
    """The tables agree with the fields on the disk."""
    with (done / "budget.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    ladders = [study.rungs(drawn(study.templates[0], 2, index)) for index in range(2)]
    assert [row["rung"] for row in rows] == [name for rungs in ladders for name in (REFERENCE, *rungs)]
    assert {row["status"] for row in rows} == {"complete"}
    with Store(done, study) as store:
        for row in rows:
            if row["rung"] == "reference":
                continue
            one = drawn(study.templates[0], 2, int(row["index"]))
            truth, own = (store.field(Job("tiny", one.index, rung)) for rung in (REFERENCE, row["rung"]))
            assert own.shape == (len(one.judged), len(places(one.scene)), 3)
            error = picture_errors(own, truth, one.scene)[0].max()
            assert float(row["error_px"]) == pytest.approx(error, rel=1e-4)  # five digits
            assert float(row["predicted_px"]) == pytest.approx(one.predicted_px(float(row["spacing_mm"])), rel=1e-4)
            assert row["within"] == str(error <= TARGET)
            assert row["chosen"] == str(row["rung"] == one.chosen_rung)
            assert float(row["seconds"]) > 0
    for index in ("0", "1"):
        errors = [float(row["error_px"]) for row in rows if row["index"] == index and row["rung"] != REFERENCE]
        assert 0 < errors[-1] < errors[0]
    assert (done / "budget.png").read_bytes().startswith(b"\x89PNG")
    text = (done / "budget.md").read_text(encoding="utf-8")
    for heading in ("## Answer", "## Misses", "## How far the references", "## All draws", "## What is not covered"):
        assert heading in text
    assert "the command" in text
    assert "nan" not in text
    assert "Unfinished" not in text
    # Nothing is left to do: the files stay as they are.
    before = (done / "budget.jsonl").read_bytes()
    status = study_budget(study, done, "the command", as_json=True)
    assert (done / "budget.jsonl").read_bytes() == before
    (counted,) = json.loads(capsys.readouterr().out)
    assert counted["judged"] == counted["draws"] == 2
    assert status == (0 if counted["met"] else 1)


def test_a_study_goes_on_where_it_stopped(
    done: Path, study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cut in pieces, in the middle of a line, and with workers: the same fields. Fails with the torn line kept."""
    assert study_budget(study, tmp_path, "c", deadline=time.monotonic()) == 1
    assert "unfinished: 0 of 8 presses" in capsys.readouterr().err
    first, second = list(jobs(study, [drawn(study.templates[0], 2, index) for index in range(2)]))[:2]
    with Store(tmp_path, study) as store:
        store.keep(press(study, first, "here"))
    lines = tmp_path / "budget.jsonl"
    whole = lines.read_bytes()
    lines.write_bytes(whole + b'{"scene": "tiny", "ind')
    ended = list(presses(study, Schedule({second: 1.0}), 2, "there"))
    assert [one.measurement.job for one in ended] == [second]
    with Store(tmp_path, study) as store:
        assert list(store.measurements) == [first]
        assert lines.read_bytes() == whole
        store.keep(ended[0])
    assert study_budget(study, tmp_path, "c") == study_budget(study, done, "c")
    assert "reference: complete" not in capsys.readouterr().err
    assert {line["machine"] for line in map(json.loads, lines.read_text().splitlines())} >= {"here", "there"}
    for file in sorted((done / "fields").iterdir()):
        assert (tmp_path / "fields" / file.name).read_bytes() == file.read_bytes()


def test_another_study_is_refused(done: Path, study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails with any of the five left out of `Study.record`."""
    other = load_scene(write_tiny(tmp_path, BUDGETED.replace(f"{TARGET}", "0.9")))
    before = (done / "budget.jsonl").read_bytes()
    for changed in (
        replace(study, seed=3),
        replace(study, across=(4, 8)),
        replace(study, reference=replace(SMALL, step_mm=0.2)),
        replace(study, templates=(other,)),
    ):
        with pytest.raises(InputError, match="holds another study"):
            Store(done, changed)
    with Store(done, replace(study, draws=3)) as store:  # more draws are more of the same
        assert len(store.measurements) == 8
    monkeypatch.setattr(budget_study, "solver", lambda: "of tomorrow")
    with pytest.raises(InputError, match=r"solver: .* there, of tomorrow now"):
        Store(done, study)
    assert (done / "budget.jsonl").read_bytes() == before


def test_a_press_on_another_mesh_is_made_again(
    done: Path, study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In place of the one that is there. Fails with measurements known by their job alone."""
    shutil.copytree(done, tmp_path / "copy")
    lines = tmp_path / "copy" / "budget.jsonl"
    kept = [json.loads(line) for line in lines.read_text().splitlines()]
    stale = next(line for line in kept if line["rung"] == "4x3" and line["index"] == 1)
    lines.write_text("".join(json.dumps({**line, "mesh": "other"} if line is stale else line) + "\n" for line in kept))
    capsys.readouterr()
    assert study_budget(study, tmp_path / "copy", "c") == study_budget(study, done, "c")
    assert capsys.readouterr().err.count("complete") == 1
    with Store(tmp_path / "copy", study) as store:
        assert {job: measurement.mesh for job, measurement in store.measurements.items()} == {
            Job(line["scene"], line["index"], line["rung"]): line["mesh"] for line in kept
        }


def test_wrong_input(tmp_path: Path, study: Study, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = str(study.templates[0].source), str(tmp_path / "out")
    fixed = str(write_tiny(tmp_path))
    for arguments, said in (
        (["--scene", fixed], "numerics.edge_length_mm"),
        (["--scene", scene, "--scene", scene], "2 scenes are named 'tiny'"),
        (["--scene", scene, "--minutes", "0"], "--minutes = 0"),
        (["--scene", scene, "--draws", "0"], "whole numbers from 1 on"),
        (["--scene", "nothing"], "there is no scene 'nothing'"),
    ):
        assert main(["bench", "budget", "--out", out, *arguments]) == 2
        assert said in capsys.readouterr().err
    assert main(["bench", "speed"]) == 2
    assert not (tmp_path / "out").exists()


ABSENT = """
import sys
sys.modules.update(dict.fromkeys((
    "mitsuba", "drjit", "pytetwild", "pyvista", "vtk", "vtkmodules", "matplotlib", "torch", "OpenEXR", "PIL", "cv2",
    "skimage", "fsspec", "ray", "lightning",
)))
from pathlib import Path
from synth.cli import main
scene, out = sys.argv[1:]
assert main(["bench", "budget", "--scene", scene, "--draws", "1", "--out", out, "--minutes", "1e-9"]) == 1
from synth.bench import budget_press, budget_study
from synth.bench.budget import study_budget
from synth.bench.budget_study import Reference, Study
from synth.scene.template import load_scene
study_budget(Study((load_scene(scene),), 2, 1, (4,), Reference(across=6)), Path(out) / "small", "c")
"""


def test_needs_neither_mesher_nor_renderer(study: Study, tmp_path: Path) -> None:
    """On a machine that has the solver's packages only; where there is no matplotlib, there is no picture."""
    arguments = [str(study.templates[0].source), str(tmp_path)]
    ended = subprocess.run(
        [sys.executable, "-c", ABSENT, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert "unfinished: 0 of" in ended.stderr
    assert "there is no matplotlib here" in ended.stderr
    small = tmp_path / "small"
    assert (small / "budget.md").exists()
    assert not (small / "budget.png").exists()
    assert {line["status"] for line in map(json.loads, (small / "budget.jsonl").read_text().splitlines())} == {
        "complete"
    }
