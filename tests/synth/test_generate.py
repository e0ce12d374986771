"""The whole chain in one process: what lands on disk, going on, growing, and draws that fail."""

import json
import re
import sys
from itertools import count, islice
from pathlib import Path

import numpy as np
import pytest
from processes_of import largest_file
from tiny_scene import fingerprint, reference

from synth.dataset.reader import read_dataset
from synth.dataset.shard import Shard
from synth.errors import InputError
from synth.pipeline.generate import Scheduling, generate
from synth.progress import progress
from synth.render.variant import choose_variant
from synth.sampling import draw
from synth.scene.template import Template, load_scene
from synth.verify import verify_dataset

pytestmark = pytest.mark.usefixtures("one_cache")
USELESS = {
    "camera.exposure=1e-3": "light is dark: the brightest per cent",
    "camera.exposure=50": "light is clipped: 9. % of the gel's pixels are at white",
    "gel.size_mm=[2, 2, 2.5]": "images show gel in",
}


def test_the_dataset_is_what_was_asked_for_and_verifies() -> None:
    dataset = read_dataset(reference())
    assert dataset.samples == [0, 1, 2, 3, 4]  # of three trajectories of two: the last one is not finished
    assert [dataset.entry(i).trajectory for i in range(5)] == [0, 0, 1, 1, 2]
    assert (dataset.failures, dataset.info["n"]) == ([], 5)
    assert dataset.info["device"]["variant"] == choose_variant("cpu").name
    assert set(dataset.info["software"]) >= {"gelflow-synth", "mitsuba", "warp-lang", "pytetwild"}
    for index in range(5):
        entry, sample = dataset.entry(index), dataset.read(index)
        assert entry.force_n[1][2] > 0  # a press
        assert set(entry.seconds) == {"simulate", "render", "flow", "write"}
        assert entry.max_flow_px > 0.05  # 0.1 mm of depth or more at 4 px per mm
        assert sample.image1.shape == (24, 32, 3)
        assert sample.image1.std() > 5  # dots and lights are in it
    assert dataset.entry(0).frames[0] == 0
    report = verify_dataset(reference())
    assert report.ok, report.record()
    # Samples 0 and 2 are of one sensor: their first images differ by noise only, sample 4's by its dots.
    first = [dataset.read(i).image1.astype(float) for i in (0, 2, 4)]
    assert dataset.scene_of(0).sensor == dataset.scene_of(2).sensor != dataset.scene_of(4).sensor
    # read_noise 0.002 in linear light is at most 255 * 0.002 ** (1 / 2.2) = 15 levels in black, and 0.2 in white.
    assert 0 < np.abs(first[0] - first[1]).mean() < 3
    assert np.abs(first[0] - first[2]).mean() > 4


def test_growing_in_steps_gives_the_same_files_and_progress_counts_up_to_n(tiny: Path, tmp_path: Path) -> None:
    """1, then 3 (which finishes a trajectory and begins another), then 5; n is in dataset.json alone."""
    out = tmp_path / "grown"
    made = [(s.made, s.found) for s in (generate(tiny, n, out) for n in (1, 3, 5, 5, 2))]
    assert made == [(1, 0), (2, 1), (2, 3), (0, 5), (0, 2)]
    assert fingerprint(out) == fingerprint(reference())
    calls, template = [], load_scene(tiny, ["motion.depth_mm=-1"])  # no touch: fast
    summary = generate(template, 3, tmp_path / "d", progress=lambda done, total: calls.append((done, total)))
    assert calls == [(2, 3), (3, 3)]
    assert summary.seconds > sum(summary.stages.values()) > 0
    entry = read_dataset(tmp_path / "d").entry(0)
    assert entry.max_flow_px == pytest.approx(0, abs=1e-4)  # float32 of a pixel number: 32 * 2^-24


def test_three_shards_in_any_order_give_the_same_files(tiny: Path, tmp_path: Path) -> None:
    template, out = load_scene(tiny), tmp_path / "d"
    done = [generate(template, 5, out, scheduling=Scheduling(shard=Shard(k, 3))) for k in (2, 0, 1)]
    said = [(s.shard, s.made, s.asked_for, s.found) for s in done]
    assert said == [("2/3", 1, 1, 0), ("0/3", 2, 2, 0), ("1/3", 2, 2, 0)]  # trajectories of samples 0 1 | 2 3 | 4
    assert fingerprint(out) == fingerprint(reference())


def test_wrong_numbers_impossible_scenes_useless_images_and_a_missing_ray_are_told(tiny, tmp_path, monkeypatch, capfd):
    sound = load_scene(tiny)
    torus = load_scene(tiny, ['contact.indenter={ shape = "torus", radius_mm = 1, tube_mm = 2 }'])
    for template, n, seed, workers, message in (
        (sound, 0, 0, 1, "--n = 0"),
        (sound, 1, -1, 1, "--seed = -1"),
        (sound, 1.5, 0, 1, "'float' object"),
        (sound, 1, 0, 0, "--workers = 0"),
        (torus, 1, 0, 1, "tube_mm"),
    ):
        with pytest.raises(InputError if n < 1.5 else TypeError, match=message):
            generate(template, n, tmp_path / "d", seed, scheduling=Scheduling(workers=workers))
        assert not (tmp_path / "d").exists()
    for workers, (override, words) in enumerate(USELESS.items()):
        template = load_scene(tiny, [f"sensor.{override}", "motion.depth_mm=-1", "numerics={}"])
        generate(template, 3, tmp_path / words, scheduling=Scheduling(workers or None))
        assert re.fullmatch(f"synth: warning: tiny: {words}.*\n", capfd.readouterr().err)  # once
    monkeypatch.setitem(sys.modules, "ray", None)  # what an import of a missing package does
    with pytest.raises(InputError, match=r"--ray needs Ray: pip install 'gelflow-synth\[cluster\]'"):
        generate(load_scene(tiny), 1, tmp_path / "d", scheduling=Scheduling(ray="local"))


def _fits(template: Template, seed: int, attempt: int) -> bool:
    try:
        draw(template, seed, 0, attempt)
    except InputError:
        return False
    return True


def test_failed_draws_are_logged_redrawn_the_same_way_in_every_run_and_summed_up(tiny: Path, tmp_path: Path) -> None:
    """A depth of which many draws are more than the gel's thickness; going on logs nothing twice."""
    template = load_scene(tiny, ["motion.depth_mm={ normal = [-1.5, 4.0] }"])
    seed = next(n for n in range(1000) if [_fits(template, n, k) for k in range(3)] == [False, False, True])
    whole = generate(template, 3, tmp_path / "whole", seed)
    assert whole.failed_draws >= 2
    assert whole.given_up == []
    failures = read_dataset(tmp_path / "whole").failures
    assert [(f["index"], f["draw"], f["stage"]) for f in failures[:2]] == [(0, 0, "draw"), (0, 1, "draw")]
    assert "motion.depth_mm" in failures[0]["reason"]
    assert failures[0]["last_good_state"] is None
    out = tmp_path / "parts"
    first, second = generate(template, 1, out, seed), generate(template, 3, out, seed)
    assert fingerprint(out) == fingerprint(tmp_path / "whole")
    # Totals of the manifest, whatever runs they were made in; failures by reason, numbers left out.
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["samples"], summary["asked_for"]) == (3, 3)
    assert summary["last_run"] == json.loads(json.dumps(second.record()))
    assert (second.made, second.found) == (2, 1)
    assert second.samples_per_second == second.made / second.seconds
    assert first.failures.total() == first.failed_draws >= 2
    assert all("#" in reason and reason.startswith("draw: ") for reason in first.failures)
    lines = [json.loads(line) for line in (out / "manifest.jsonl").read_text().splitlines()]
    for stage, seconds in summary["seconds_per_stage"].items():
        # Rounded to a thousandth there: up to 5e-4 off, and the rounding of a tie.
        assert seconds == pytest.approx(sum(line["seconds"][stage] for line in lines), abs=5.1e-4)
    assert sum(summary["share_per_stage"].values()) == pytest.approx(1, abs=2e-4)  # four, each rounded to 0.00005
    assert summary["failed_draws"] == len((out / "failures.jsonl").read_text().splitlines())


def test_a_simulation_that_fails_is_logged_with_its_last_good_state_and_redrawn(tiny: Path, tmp_path: Path) -> None:
    """A gel stuck to a ball that moves by twice its thickness tears; should the solver learn it, ask for more here."""
    hard = ["contact.friction=10", "motion.depth_mm=1.9", "numerics.max_step_mm=20.0"]
    template = load_scene(tiny, [*hard, "motion.shear_mm={ choice = [[0.05, 0.0], [4.9, 4.9]] }", "motion.steps=2"])

    def is_wanted(seed: int) -> bool:
        return [draw(template, seed, 0, attempt).motion.shear_mm[0] for attempt in (0, 1)] == [4.9, 0.05]

    for seed in islice(filter(is_wanted, count()), 5):
        out = tmp_path / str(seed)
        summary = generate(template, 1, out, seed)
        assert summary.made == 1
        if summary.failed_draws:  # on some of the mesher's random meshes the press completes after all
            break
    failures = read_dataset(out).failures  # on others that of the second instance fails, too
    assert len(failures) == summary.failed_draws >= 1
    failure = failures[0]
    assert (failure["index"], failure["draw"], failure["stage"]) == (0, 0, "simulate")
    assert "Newton" in failure["reason"]
    assert failure["last_good_state"]["converged"]
    assert failure["last_good_state"]["shear_mm"][0] < 4.9
    assert read_dataset(out).scene_of(0).motion.shear_mm == (0.05, 0.0)


@pytest.mark.parametrize(("field", "stage"), [("motion.depth_mm", "draw"), ("sensor.camera.vignetting", "sensor")])
def test_samples_whose_every_draw_fails_are_given_up(tiny: Path, tmp_path: Path, field: str, stage: str) -> None:
    template = load_scene(tiny, [f"{field}={{ normal = [0.2, 1e9] }}"])
    for _ in range(2):  # again: neither more samples nor more lines
        summary = generate(template, 3, tmp_path / "d")
        assert (summary.made, summary.given_up, summary.failed_draws) == (0, [0, 1, 2], 20)
        dataset = read_dataset(tmp_path / "d")
        assert dataset.samples == []
        assert [(f["index"], f["draw"]) for f in dataset.failures] == [(i, k) for i in (0, 2) for k in range(10)]
        assert {f["stage"] for f in dataset.failures} == {stage}


def test_a_mesh_that_cannot_be_kept_stops_the_job(tiny: Path, tmp_path: Path) -> None:
    """Without it every trajectory would be computed on a mesh of its own."""
    with pytest.raises(InputError, match=r"meshes/\w+\.npz: the mesh cannot be written"), largest_file(6000):
        generate(load_scene(tiny), 1, tmp_path / "d")
    assert list((tmp_path / "d" / "samples").iterdir()) == []


def test_a_full_disk_loses_nothing_and_tears_nothing(tiny: Path, tmp_path: Path) -> None:
    """The second half of the job meets the limit; with space again, it ends as if nothing had been."""
    template, out = load_scene(tiny), tmp_path / "d"
    generate(template, 2, out)
    finished = fingerprint(out)
    refusal = r"cannot be written: .*File too large.*finished before is safe"
    with pytest.raises(InputError, match=refusal), largest_file(6000):
        generate(template, 5, out)
    assert {**fingerprint(out), "dataset.json": finished["dataset.json"]} == finished
    assert json.loads((out / "dataset.json").read_text())["n"] == 5
    generate(template, 5, out)
    assert fingerprint(out) == fingerprint(reference())


@pytest.mark.parametrize(("pace", "lines"), [
    (10.0, ["8 of 12, 10.0 s each, about 40.0 s left"]),
    (0.1, []),
    (70.0, ["3 of 12", *(f"{done} of 12, 70.0 s each, about " for done in range(4, 12))]),
])  # fmt: skip
def test_a_line_a_minute_where_stderr_is_no_terminal(capsys, monkeypatch, pace: float, lines: list[str]) -> None:
    """Two of twelve were there before; each of the others takes `pace` seconds."""
    clock = [0.0]
    monkeypatch.setattr("synth.progress.time.monotonic", lambda: clock[0])
    with progress("generate: pairs", 12) as advance:
        for done in range(3, 13):
            clock[0] += pace
            advance(done, 12)
    out, err = capsys.readouterr()
    assert out == ""
    for line, start in zip(err.splitlines(), lines, strict=True):
        assert line.startswith(f"synth: generate: pairs: {start}")
