"""The study of the error budget: its arithmetic on numbers made by hand, and its workings on presses of a second."""

import csv
import json
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
from synth.bench.budget_draws import misses
from synth.bench.budget_field import picture_errors, places
from synth.bench.budget_pool import presses
from synth.bench.budget_press import Measurement, press, ready_stepper
from synth.bench.budget_schedule import OVERHEAD_S, Schedule
from synth.bench.budget_store import Store
from synth.bench.budget_study import REFERENCE, Job, Reference, Study, drawn, jobs
from synth.bench.budget_tally import tally
from synth.bench.budget_verdict import Rung, Verdict
from synth.cli import main
from synth.errors import InputError
from synth.sampling import draw, pairs_of
from synth.simulate import simulate
from synth.simulate.resolution import LADDER, Fineness, Resolution, ladder, resolve, scale_px_per_mm
from synth.template import load_scene

ROOT = Path(__file__).parents[2]
TARGET = 0.004
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


def measured(rung: int | str, seconds: float = 1.0, unknowns: int = 100, status: str = "complete") -> Measurement:
    name = rung if isinstance(rung, str) else f"{rung}x2"
    spacing = 0.1 if isinstance(rung, str) else 1.8 / rung
    return Measurement(
        scene="tiny", index=0, rung=name, status=status, reason="" if status == "complete" else "stuck",
        seconds=seconds, wall_s=seconds, setup_s=0.0, unknowns=unknowns, spacing_mm=spacing, predicted_px=0.4,
        penetration_mm=0.001, iterations=1, attempt=0, mesh="", machine="m",
    )  # fmt: skip


def judged(errors: dict[int, float], chosen: int, target: float = 0.5, **changes: object) -> Verdict:
    """A draw whose rungs cost across seconds, and by unknowns (across / 4)^1.5."""
    rungs = tuple(Rung(measured(k, seconds=k, unknowns=25 * k), error) for k, error in errors.items())
    verdict = Verdict("tiny", 0, "sphere", 0.5, target, f"{chosen}x2", 0.4, rungs, measured(REFERENCE))
    return replace(verdict, **changes)  # type: ignore[arg-type]


def test_chosen_is_the_cheapest() -> None:
    verdict = judged({4: 0.9, 6: 0.5, 8: 0.2}, chosen=6)  # on the target is within it
    assert verdict.within
    assert verdict.cheapest() is verdict.chosen_rung
    assert verdict.ratio() == 1
    assert verdict.affordable()


def test_chosen_is_dearer_than_needed() -> None:
    """Fails with the cheapest taken over all rungs, and with the dearest taken."""
    verdict = judged({4: 0.6, 6: 0.4, 8: 0.3, 14: 0.1}, chosen=14)
    assert verdict.cheapest() is verdict.rungs[1]
    assert verdict.ratio() == pytest.approx(14 / 6)
    assert verdict.ratio(nominal=True) == pytest.approx((14 / 6) ** 1.5)
    assert not verdict.affordable()
    assert judged({4: 0.6, 6: 0.4, 12: 0.1}, chosen=12).affordable()  # twice is allowed
    assert not judged({4: 0.6, 6: 0.4, 12: 0.1}, chosen=12).affordable(nominal=True)


def test_chosen_is_cheaper_than_needed() -> None:
    verdict = judged({4: 0.6, 6: 0.55, 8: 0.4}, chosen=4)
    assert not verdict.within
    assert verdict.ratio() == 0.5
    assert verdict.affordable()
    (row,) = [line for line in misses([verdict], []) if line.startswith("| tiny")]
    assert "8x2 would have, 2 times the time" in row
    assert "predicted 1.5 times too little" in row


def test_no_rung_is_within_the_budget() -> None:
    """Fails with the draw counted among those that can be paid for."""
    verdict = judged({4: 0.9, 6: 0.8}, chosen=6)
    assert verdict.judged
    assert not verdict.within
    assert verdict.cheapest() is None
    assert np.isnan(verdict.ratio())
    assert not verdict.affordable()
    counted = tally("tiny", [verdict, judged({4: 0.4, 6: 0.3}, chosen=6)])
    assert (counted.judged, counted.within, counted.payable, counted.affordable) == (2, 1, 1, 1)
    assert not counted.met
    assert any("no mesh that was run met the target" in line for line in misses([verdict], []))


def test_a_coarse_rung_may_be_within_where_a_finer_one_is_not() -> None:
    """Errors need not fall from rung to rung; a press that did not end is none that would have done."""
    verdict = judged({4: 0.45, 6: 0.55, 8: 0.3}, chosen=8)
    assert verdict.ratio() == 2
    ended = (Rung(measured(4, status="partial"), float("nan")), *verdict.rungs[1:])
    assert replace(verdict, rungs=ended).ratio() == 1


def test_draws_of_which_nothing_can_be_said_are_told() -> None:
    """Fails with any of the three left out of `trouble`."""
    errors = {4: 0.4, 6: 0.3}
    no_reference = judged(errors, 4, reference=measured(REFERENCE, status="partial"))
    ended = Rung(measured(4, status="failed"), float("nan"))
    no_press = judged(errors, 4, rungs=(ended, Rung(measured(6), 0.3)))
    unfinished = judged(errors, 4, missing=1)
    for verdict in (no_reference, no_press, unfinished):
        assert not verdict.judged
    assert "the reference is partial: stuck" in no_reference.trouble
    assert "`generate` replaces the draw" in no_press.trouble
    counted = tally("tiny", [no_reference, no_press, unfinished, judged(errors, 4)], undrawn=1)
    assert (counted.draws, counted.unfinished, counted.judged, counted.within) == (5, 1, 1, 1)
    told = "\n".join(misses([no_reference, no_press, unfinished], [("tiny", "no | attempt")]))
    assert told.count("| tiny |") == 3
    assert "the reference is partial" in told
    assert "not drawn: no / attempt" in told


def test_two_estimates_of_what_the_reference_leaves_open() -> None:
    """A reference of half the spacing has 0.5^1.6 of the error. Fails with the rate's sign changed."""
    verdict = judged({4: 0.3, 9: 0.2, 16: 0.04}, chosen=9)
    own = 0.04 / (1.125**1.6 - 1)  # of the reference: the finest rung has a spacing of 1.8 / 16 = 0.1125 mm
    assert verdict.added_px == pytest.approx(0.2 + own)
    assert verdict.extrapolated_px == pytest.approx(0.2 / (1 - 0.5**1.6))  # spacings of 0.2 and 0.1 mm
    assert judged({4: 0.0}, chosen=4).extrapolated_px == 0
    counted = tally("tiny", [replace(verdict, target_px=target) for target in (0.19, 0.22, 0.3, 0.41)])
    assert (counted.within, counted.added, counted.extrapolated) == (3, 1, 2)


def test_tally_of_known_numbers() -> None:
    """Error over target 0.1 to 2.0: the 95th percentile lies 0.05 of the way from the 19th to the 20th."""
    verdicts = [judged({4: 0.05 * k}, chosen=4) for k in range(1, 21)]
    counted = tally("tiny", verdicts)
    assert counted.median == pytest.approx(1.05)
    assert counted.high == pytest.approx(1.905)
    assert counted.within == 10
    assert counted.bias == pytest.approx(np.exp(np.mean(np.log(0.05 * np.arange(1, 21) / 0.4))))
    assert not counted.met
    # 19 of 20 are 95 %.
    assert tally("tiny", [*[judged({4: 0.1}, 4)] * 19, verdicts[-1]]).met
    assert not tally("tiny", [*[judged({4: 0.1}, 4)] * 18, *verdicts[-2:]]).met
    assert tally("tiny", [judged({4: 0.0}, 4, predicted_px=0.0)]).met  # untouched


def test_errors_of_known_fields(study: Study) -> None:
    """A shift along the face is one of the picture. Fails with the mean in place of the root mean square."""
    scene = draw(study.templates[0], 2, 0)
    points, scale = places(scene), scale_px_per_mm(scene)
    camera, size = scene.sensor.camera, scene.sensor.gel.size_mm
    # Of the pad's points those in the picture: the picture's share of the pad's area, within a row and a column.
    share = camera.width * camera.height / scale**2 / (size[0] * size[1])
    assert len(points) == pytest.approx(share * 81 * 67, rel=0.05)
    zero = np.zeros((3, len(points), 3))
    moved = zero.copy()
    moved[0] += (0.03, 0.04, 0.0)
    half = np.arange(len(points)) % 2 == 0
    moved[1, half] += (0.0, 0.1, 0.0)
    found = picture_errors(moved, zero, scene)
    # The magnification is the same all over the face, to the 1e-3 by which slanted rays refract otherwise.
    np.testing.assert_allclose(found, [0.05 * scale, 0.1 * scale * np.sqrt(half.mean()), 0], rtol=5e-3)


def test_a_draw_is_that_of_generate(study: Study) -> None:
    template = study.templates[0]
    one = drawn(template, 2, 1)
    assert one.scene == draw(template, 2, 1)
    assert one.chosen.mesh.hash == resolve(one.scene, template.source.parent).mesh.hash
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


def test_what_would_end_too_late_is_not_begun() -> None:
    """Fails with the deadline left out, with a begun job begun again, and with the last pace, not the largest."""
    now = [0.0]
    long, middle, short = (Job("tiny", 0, rung) for rung in ("16x4", "8x3", "4x2"))
    other = Job("tiny", 1, "16x4")
    schedule = Schedule({long: 8.0, other: 8.0, middle: 2.0, short: 1.0}, 100.0, lambda: now[0])
    assert schedule.begin() == long  # nothing is known yet
    now[0] = OVERHEAD_S + 20.0  # 2.5 s for each of its 8
    schedule.end(long)
    assert schedule.begin() == other
    now[0] += OVERHEAD_S + 16.0  # 2 s each
    schedule.end(other)
    assert schedule.begin() == short  # 76 + 20 + 2.5 s; the middle one would take until 76 + 20 + 2 * 2.5
    assert schedule.begin() is None
    now[0] = 0.0
    assert schedule.begin() == middle
    assert schedule.begin() is None
    assert Schedule({long: 1.0}, 100.0, lambda: 100.0).begin() is None


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
            error = picture_errors(own, truth, one.scene).max()
            assert float(row["error_px"]) == pytest.approx(error, rel=1e-4)  # five digits
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
from synth.template import load_scene
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
