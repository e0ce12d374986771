"""`bench scale`: a real run of a tiny scene, the arithmetic of a made-up one, and wrong arguments."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import drjit
import pytest
from tiny_scene import own_cache, write_tiny

from synth.bench.scale_measure import Cell, Setting, at_size
from synth.bench.scale_report import fastest, index_bytes, report
from synth.cli import main


@pytest.fixture(autouse=True)
def _cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mesh for all runs: the mesher is random."""
    own_cache(monkeypatch)


CELL = Cell(
    setting=Setting(320, 240, 1),
    variant="llvm_ad_rgb",
    startup_s=7.0,
    pairs=8,
    seconds=4.0,
    first_pairs=4,
    first_seconds=2.5,
    stages={"simulate": 0.3, "render": 0.1, "flow": 0.05, "write": 0.04},
    first_stages={"simulate": 0.4, "render": 0.1, "flow": 0.05, "write": 0.04},
    bytes_per_pair=2e6,
    limits={"render": 0.08, "write": 0.01},
)


def test_arithmetic() -> None:
    """8 pairs in 4 s, of which the first 4 took 2.5 s, as their draws cost more; 5000 pairs take 7 + 2500 s."""
    assert CELL.pairs_per_second == 2
    assert CELL.growth == pytest.approx(1.6)
    assert CELL.draws_growth == pytest.approx(2 * 0.49 / 0.59)
    others = [replace(CELL, setting=Setting(320, 240, workers), seconds=s) for workers, s in ((None, 3.2), (2, 2.5))]
    text = report("some", [CELL, *others], 0, "command")
    assert "| 320 x 240 | none | 8 | 7.0 | 2.500 | 1.25 |" in text
    assert "| 320 x 240 | 2 | 8 | 7.0 | 3.200 | 1.60 |" in text
    assert "with 2 workers, 3.200 pairs/s" in text
    assert "| 320 x 240 | render | 0.1000 | 20% | 0.0800 | 1.25 |" in text
    assert "| 320 x 240 | other | 0.0100 | 2% |" in text  # 0.5 s a pair less the stages' 0.49
    # With the faster of the two: 7 s + 5000 / 3.2 s.
    assert "| 5,000 | 26.2 min | 1 | 10.0 GB | 25,000 |" in text
    assert "| 50,000,000 | 180.8 days | 181 | 100.0 TB | 250,000,000 |" in text
    assert "The first bottleneck is `simulate` (61% of the work)" in text


def test_the_fastest_is_among_the_largest_images() -> None:
    small = replace(CELL, setting=Setting(32, 24, 1), seconds=0.1)
    assert fastest([small, CELL]) is CELL


def test_another_size_keeps_the_field_of_view(tmp_path: Path) -> None:
    scene = str(write_tiny(tmp_path))
    before, after = (
        at_size(scene, ["sensor.camera.cy=9.0"], *size).corners[0].sensor.camera for size in ((32, 24), (64, 36))
    )
    assert (after.width, after.height) == (64, 36)
    # Half the image over the focal length is the tangent of half the angle; written with 6 decimals.
    assert after.width / after.fx == pytest.approx(before.width / before.fx, rel=1e-7)
    assert after.height / after.fy == pytest.approx(before.height / before.fy, rel=1e-7)
    assert after.cy / after.height == pytest.approx(9 / 24, rel=1e-7)  # of the scene that was changed


def test_the_index_grows_by_what_python_needs() -> None:
    """A tuple with two integers, two dictionary entries and two set entries: 56 + 28 + 28 + ... bytes at least."""
    assert 150 < index_bytes() < 600


def test_a_real_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No touch: no solve, all else real."""
    command = ["bench", "scale", "--scene", str(write_tiny(tmp_path)), "--n", "4", "--size", "32x24", "--workers", "1"]
    command += ["--set", "motion.depth_mm=-1.0"]
    threads = drjit.thread_count()
    assert main([*command, "--json", "--out", str(tmp_path / "out")]) == 0
    assert drjit.thread_count() == threads  # fails with the limit's one thread left to what comes next
    alone, row = json.loads(capsys.readouterr().out)
    assert (alone["width"], alone["height"], alone["workers"], alone["pairs"]) == (32, 24, None, 8)
    assert (row["width"], row["height"], row["workers"], row["pairs"]) == (32, 24, 1, 8)
    assert "render_limit_s" not in alone
    assert row["pairs_per_second"] == pytest.approx(row["pairs"] / row["seconds"], rel=1e-2)  # both rounded
    work = sum(row[f"{stage}_s"] for stage in ("simulate", "render", "flow", "write"))
    assert 0 < work <= row["seconds"] / row["pairs"] * 1.05  # one worker: stages are parts of the whole, rounded
    assert sum(alone[f"{stage}_s"] for stage in ("simulate", "render", "flow", "write")) <= alone["seconds"] / 8 * 1.05
    assert 0 < row["write_limit_s"] < row["write_s"]  # encoding comes on top
    assert row["render_limit_s"] > 0
    assert row["bytes_per_pair"] > 5000
    # Of the same pairs, less digits of seconds. Fails with the files of the limit among them.
    assert row["bytes_per_pair"] == pytest.approx(alone["bytes_per_pair"], rel=0.01)
    assert math.isfinite(row["growth"])
    with (tmp_path / "out" / "scale.csv").open() as file:
        assert [float(line["seconds"]) for line in csv.DictReader(file)] == [alone["seconds"], row["seconds"]]
    assert "--set motion.depth_mm=-1.0` on" in (tmp_path / "out" / "scale.md").read_text()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["scale.csv", "scale.md"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "640"], "--size 640: give WIDTHxHEIGHT"),
        (["--workers", "0"], "--workers 0: at least 1"),
        (["--set", "motion.dept_mm=1"], "motion.dept_mm: unknown key"),
    ],
)
def test_wrong_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
    assert main(["bench", "scale", "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
