"""Whole runs of render, light, flow and scale on the tiny scene, and what they refuse. No test asserts a time."""

from pathlib import Path

import pytest
from commands import said
from PIL import Image
from render_scenes import needs_llvm
from tiny_scene import TEXT, own_cache, write_tiny

import synth.cli
from benchmarks import round_gel
from benchmarks.__main__ import main
from benchmarks.draws import summaries, together
from benchmarks.render import DEEPEST, settings
from benchmarks.rows import Row, read
from benchmarks.scale import at_size, rates

NOISY = TEXT.replace("read_noise = 0.002", "read_noise = 0.1")  # A camera so noisy that "auto" needs few samples


@pytest.fixture(autouse=True)
def _cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mesh for all runs: the mesher is random."""
    own_cache(monkeypatch)


def again(command: list[str], out: Path, *tables: str) -> list[list[Row]]:
    """The tables of a run, which the same command repeated does not measure again."""
    assert main([*command, "--out", str(out)]) == 0
    before = [(out / table).read_bytes() for table in tables]
    assert main([*command, "--out", str(out)]) == 0
    assert [(out / table).read_bytes() for table in tables] == before
    return [read(out / table) for table in tables]


@needs_llvm
def test_render(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, out = write_tiny(tmp_path, NOISY), tmp_path / "out"
    command = ["render", "--scene", str(scene), "--device", "cpu", "--reference", "240", "--seeds", "3", "--scale", "1"]
    images, flows, autos = again(command, out, "render.csv", "render_flow.csv", "render_auto.csv")
    assert {row["variant"] for row in images} == {"llvm_ad_rgb"}
    # Without a window the radiance is not divided by n² = 2.1: another image by far.
    assert all((row["rmse"] > 20) != row["window"] for row in images)
    assert all(row["seconds"] > 0 and row["processor_s"] > 0 for row in images)
    # A reference of the same number of samples would have 10 % of the camera's noise.
    assert all(row["reference_noise"] < row["noise"] < row["camera_noise"] for row in images)
    full = [row for row in images if row["window"] and row["max_depth"] == DEEPEST]
    assert all(abs(row["bias_percent"]) < 4 * row["bias_se_percent"] for row in full)
    assert all(row["auto_share"] < 0.2575 for row in autos)  # a quarter, and 3 % for the noise's own uncertainty
    assert all(row["scene_samples"] == 20 for row in autos)  # 4 are asked for; two for each of five lights and images
    by_samples = {(row["samples"], row["camera_noise"]): row for row in flows}
    assert len(by_samples) == len(flows) == 8  # 15, 20, 80 and 195 samples, noise off and on
    # More render noise moves the measured flow farther from that without; a factor of 10 in samples.
    assert by_samples[15, False]["difference_px"] > by_samples[195, False]["difference_px"]
    assert "llvm_ad_rgb" in capsys.readouterr().out
    assert all((out / f"{name}.png").read_bytes().startswith(b"\x89PNG") for name in ("render", "render_flow"))


def test_draws_on_the_cpu_and_by_the_batched_solver(tmp_path: Path) -> None:
    scene = str(write_tiny(tmp_path, TEXT))
    alone = again(["draws", "--scenes", scene, "--draws", "2"], tmp_path / "out", "draws_cpu.csv")[0]
    batched = [{"scene": scene, **row} for row in together({"device": "cpu", "scene": scene, "seed": 0, "draws": 2}, 1)]
    for rows in (alone, batched):
        assert [row["trajectory"] for row in rows] == [0, 1]
        assert [line["share"] for line in summaries(rows)] == ["100.00%", "100.00%"]
        assert all(row["iterations"] > 0 and row["penetration"] > 0 for row in rows)
    failed = {**alone[0], "status": "failed", "reason": "made up"}
    assert [line["share"] for line in summaries([*alone, failed])] == ["66.67%", "66.67%"]


def test_settings_of_images_differ_and_rates_of_a_made_up_run() -> None:
    found = settings(["fast", "slow"], 2, 4, 1200)
    assert len(found) == len({tuple(row.values()) for row in found})
    assert max(row["samples"] for row in found) <= 200
    assert {row["max_depth"] for row in found} == {2, 3, 4, 6, DEEPEST}
    assert {row["variant"] for row in found if not row["window"]} == {"fast", "slow"}
    assert all(row["samples"] % 2 == 0 for row in found)  # a multiple of the lights, as it is really taken
    # 8 pairs in 4 s after 7 s of start-up, of which the first 4 took 2.5 s, as their presses cost more.
    seconds = {"render": 0.1, "flow": 0.05, "write": 0.04}
    entries = [{"index": k, "seconds": {"simulate": 0.4 if k < 6 else 0.2, **seconds}} for k in range(10)]
    found = rates({2: 7.0, 6: 9.5, 10: 11.0}, entries, 2, 4)
    expected = {"startup_s": 7.0, "pairs": 8, "seconds": 4.0, "pairs_per_second": 2.0, "growth": 1.6,
                "work_growth": 2 * 0.49 / 0.59, "simulate_s": 0.3, "other_s": 0.01}  # fmt: skip
    # 0.5 s a pair less the stages' 0.49 are for other things.
    assert {name: found[name] for name in expected} == pytest.approx(expected)


@needs_llvm
def test_light(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["light", str(write_tiny(tmp_path, NOISY)), "--device", "cpu", "--reference", "64"]
    images, flows = again(command, tmp_path / "out", "light.csv", "light_flow.csv")
    # Two states by path tracing and three numbers of samples; two methods on these and on the reference's halves.
    assert [row["light"] for row in images] == 2 * ["path_traced"] + 6 * ["separated"]
    assert len(flows) == 2 * 5
    # The same image: no systematic error beyond four standard errors of its square, of which the limit has two.
    assert all(row["systematic"] ** 2 < 2 * row["systematic_limit"] ** 2 for row in images)
    # A quarter of the error with fewer samples; 3 images of 768 pixels tell each within a few per cent.
    traced, separated = ({row["state"]: row for row in images if row["samples"] == samples} for samples in (15, 9))
    for state, row in separated.items():
        assert row["share"] < traced[state]["share"] / 2
        assert row["noise"] < traced[state]["noise"] / 2
    assert "path_tracing_s" in capsys.readouterr().out
    (tmp_path / "shining").mkdir()
    shining = write_tiny(tmp_path / "shining", NOISY + "\n[sensor.coating]\nroughness = 0.5\n")
    refusal = said(capsys, main, "light", shining, "--device", "cpu", "--out", tmp_path / "other", status=2)
    assert "needs a matt coating" in refusal


def test_flow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, out = str(write_tiny(tmp_path)), tmp_path / "out"
    (rows,) = again(["flow", scene, scene], out, "flow.csv")
    assert len(rows) == len({row["method"] for row in rows})  # a scene counts once
    assert rows[0]["max_px"] < 1e-5  # float32 flow of a few px
    assert all(row["ms"] > 0 for row in rows)
    assert (out / "flow.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr("benchmarks.flow.FLOW_TOLERANCE_PX", 0.0)
    assert main(["flow", scene, "--out", str(out)]) == 1


@pytest.mark.slow
def test_round_gel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, edges_mm in {"EVEN": (3.0, 1.6), "FINER": (), "REFERENCE": 1.0}.items():
        monkeypatch.setattr(round_gel, name, edges_mm)
    ((coarse, even, whole),) = again(["round_gel"], tmp_path / "out", "round_gel.csv")
    assert even["flow_percent"] < coarse["flow_percent"]
    assert even["flow_percent"] == pytest.approx(whole["flow_percent"], rel=0.1)


def test_throughput_keeps_earlier_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "throughput.csv"
    for label in ("before", "after"):
        command = ["throughput", "--scene", str(write_tiny(tmp_path)), "--n", "4", "--table", str(table)]
        assert main([*command, "--size", "32x24", "--label", label]) == 0
    before, after = read(table)
    assert (before["label"], after["label"], after["size"], after["pairs"]) == ("before", "after", "32x24", 4)
    for row in (before, after):
        assert 0 < row["first_s"] < row["total_s"]
        assert row["share_of_limit"] == pytest.approx(row["pairs_per_second"] / row["cores_limit"], rel=1e-3)
    assert "before" in capsys.readouterr().out


def test_scale(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["scale", "--scene", str(write_tiny(tmp_path)), "--n", "4", "--size", "32x24", "--workers", "1"]
    ((row,),) = again([*command, "--set", "motion.depth_mm=-1.0"], tmp_path / "out", "scale.csv")
    assert (row["workers"], row["pairs"]) == (1, 8)
    assert row["pairs_per_second"] == row["pairs"] / row["seconds"]
    work = sum(row[f"{stage}_s"] for stage in ("simulate", "render", "flow", "write"))
    assert 0 < work <= row["seconds"] / row["pairs"]  # one process: stages are parts of the whole
    assert row["bytes_per_pair"] > 1000
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["scale.csv", "scale.png"]
    assert "Extrapolated from 32 x 24 px" in capsys.readouterr().out


def test_another_size_keeps_the_field_of_view(tmp_path: Path) -> None:
    scene = str(write_tiny(tmp_path))
    templates = (at_size(scene, ["sensor.camera.cy=9.0"], *size) for size in ((32, 24), (64, 36)))
    before, after = (template.corners[0].sensor.camera for template in templates)
    assert (after.width, after.height) == (64, 36)
    # Half the image over the focal length is the tangent of half the angle; written with 6 decimals.
    assert after.width / after.fx == pytest.approx(before.width / before.fx, rel=1e-7)
    assert after.height / after.fy == pytest.approx(before.height / before.fy, rel=1e-7)
    assert after.cy / after.height == pytest.approx(9 / 24, rel=1e-7)  # of the scene that was changed


@pytest.mark.parametrize(("command", "message"), [
    (["scale", "--size", "640"], "--size 640: give WIDTHxHEIGHT"),
    (["scale", "--workers", "-1"], "--workers: give whole numbers from 1 on"),
    (["scale", "--set", "motion.dept_mm=1"], "motion.dept_mm: unknown key"),
    (["render", "--seeds", "2"], "--seeds 2: the standard error of the flow's change needs at least 3"),
    (["render", "--scene", "nowhere"], "nowhere"),
])  # fmt: skip
def test_wrong_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str], message: str) -> None:
    assert message in said(capsys, main, *command, "--out", tmp_path / "out", status=2)


def test_pictures_of_two_data_sets(tmp_path: Path) -> None:
    folder, out = str(tmp_path / "a"), tmp_path / "out.png"
    assert synth.cli.main(["generate", "--scene", str(write_tiny(tmp_path)), "--n", "1", "--out", folder]) == 0
    sizes = []
    for kind, count in (("gallery", 2), ("row", 2), ("row", 1)):
        assert main(["pictures", kind, *[folder] * count, "--out", str(out)]) == 0
        sizes.append(Image.open(out).size)
    assert sizes[0] == (1290, 180)
    assert sizes[1] == (pytest.approx(2 * sizes[2][0], abs=1), sizes[2][1])
