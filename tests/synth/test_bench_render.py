"""`bench render`: statistics of made-up pictures, real pictures of a small bump, DIS on a shifted image, a whole run.

No test asserts a time.
"""

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from render_scenes import flat_surface, plain, small_sensor
from tiny_scene import TEXT, own_cache, write_tiny

from synth.arrays import Image
from synth.bench.render_auto import Choice
from synth.bench.render_error import Errors, Reference, errors, measured_camera_noise, reference_noise, slope
from synth.bench.render_findings import pareto_front
from synth.bench.render_flow import Truth, dis, is_seen, is_unseen, jackknife
from synth.bench.render_measure import DEEPEST, Cell, Setting, measure, reference, settings, variants
from synth.bench.render_subject import View, resized
from synth.cli import main
from synth.render.camera_image import expected_signal
from synth.render.sample_count import camera_noise
from synth.render.variant import choose_variant
from synth.scene import Light

FAST = choose_variant("cpu")
needs_llvm = pytest.mark.skipif(not FAST.is_vectorised, reason="no LLVM of version 16 or newer here")


@pytest.fixture(autouse=True)
def _cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mesh for all runs: the mesher is random."""
    own_cache(monkeypatch)


def _pictures(count: int, deviation: float, offset: float = 0.0, seed: int = 0) -> list[Image]:
    """Pictures of 0.25 with independent Gaussian noise in every value."""
    rng = np.random.default_rng(seed)
    shape = (60, 80, 3)
    return [(0.25 + offset + deviation * rng.standard_normal(shape)).astype(np.float32) for _ in range(count)]


LINEAR = small_sensor(gamma=1.0).camera


def test_statistics_of_known_pictures() -> None:
    """Noise 0.01 in the pictures, 0.008 in each half of the reference, an offset of 0.004, full scale 255 levels.

    Fails with the reference's noise not subtracted (rmse 3.10), and with twice that subtracted (rmse 2.34).
    """
    first, second = _pictures(2, 0.008, seed=1)
    truth = Reference((first, second), 2)
    found = errors(_pictures(4, 0.01, 0.004), truth, LINEAR)
    # 14400 values: a standard deviation is known within 1 / sqrt(2 · 14400) = 0.6 %, here of several; 4 times that.
    assert found.noise == pytest.approx(2.55, rel=0.024)
    assert reference_noise(truth, LINEAR) == pytest.approx(255 * 0.008 / 2**0.5, rel=0.024)
    assert found.rmse == pytest.approx(255 * (0.01**2 + 0.004**2) ** 0.5, rel=0.024)
    # systematic² = 1.04: its standard error, module's formula with channels as one: 0.084; of their being three, less.
    assert found.systematic**2 == pytest.approx(1.02**2, abs=4 * 0.084)
    assert found.systematic > found.systematic_limit
    # Bias: 1.6 %; the mean of 14400 values of 4 pictures and of the reference: sqrt(0.01²/4 + 0.008²/2) / 120 / 0.25.
    assert found.bias_percent == pytest.approx(1.6, abs=4 * 0.025)
    assert found.bias_se_percent == pytest.approx(0.025, rel=0.05)


def test_standard_errors_hold_where_there_is_nothing_systematic() -> None:
    """Of 60 made-up settings without offset the scores must scatter as their standard errors say.

    Fails with a standard error of the bias that forgets the reference's noise: scores of 1.53.
    """
    scores, beyond = [], 0
    for k in range(60):
        truth = Reference(tuple(_pictures(2, 0.01, seed=1000 + k)), 2)  # type: ignore[arg-type]
        found = errors(_pictures(3, 0.01, seed=k), truth, LINEAR)
        scores.append(found.bias_percent / found.bias_se_percent)
        beyond += found.systematic > found.systematic_limit
    # A standard deviation of 60 scores: within 1 ± 4 / sqrt(120).
    assert np.std(scores) == pytest.approx(1, abs=0.37)
    # Channels count as one though they are three: the limit is at 2 sqrt(3) standard errors, 0.03 % of the cases.
    assert beyond <= 1


def test_blur_makes_neighbours_alike() -> None:
    """The limit of the systematic error grows as the blur makes fewer values independent. Fails with alike = 1."""
    blurred = LINEAR.model_copy(update={"blur_px": 4.0})
    beyond = []
    for k in range(60):
        truth = Reference(tuple(_pictures(2, 0.01, seed=2000 + k)), 2)  # type: ignore[arg-type]
        found = errors(_pictures(3, 0.01, seed=3000 + k), truth, blurred)
        beyond.append(found.systematic > found.systematic_limit)
    assert sum(beyond) <= 1


def test_one_picture_has_no_noise_to_tell() -> None:
    with pytest.raises(ValueError, match="at least two"):
        errors(_pictures(1, 0.01), Reference(tuple(_pictures(2, 0.01, seed=1)), 2), LINEAR)  # type: ignore[arg-type]


def test_measured_camera_noise_is_the_models() -> None:
    """A grey of 0.25, where noise of 0.02 is far from both ends of the scale, and 16 bits."""
    camera = small_sensor(gamma=1.0, shot_noise=0.04, bit_depth=16).camera
    grey = np.full((60, 80, 3), 0.25, dtype=np.float32)
    # 14400 values: 0.6 %, 4 times.
    assert measured_camera_noise(grey, camera) == pytest.approx(255 * camera_noise(grey, camera), rel=0.024)


LIGHTS = tuple(Light(position_mm=(x, 1.0, 3.0), size_mm=(3, 1), color=(1, 1, 1), power=400) for x in (-7.0, 7.0))
SIZE: dict[str, float] = {"width": 40, "height": 30, "fx": 70.0, "fy": 70.0, "cx": 21.25, "cy": 14.25, "blur_px": 0.8}


def _bump() -> View:
    """A bright gel with a steep bump toward the camera, whose flanks light the plain around."""
    sensor = small_sensor(1.45, None, LIGHTS, **SIZE)
    surface = flat_surface(sensor, 24)
    pressed = surface.material.copy()
    pressed[:, 2] += 1.5 * np.exp(-(pressed[:, 0] ** 2 + pressed[:, 1] ** 2) / 1.2**2)
    return View(sensor, plain(0.8), surface, pressed)


@cache
def _measured() -> dict[tuple[int, int], Cell]:
    """Real pictures by path depth and samples, against a reference of the deepest."""
    view = _bump()
    wanted = [Setting(FAST, True, DEEPEST, n) for n in (16, 64, 256)] + [Setting(FAST, True, 2, 64)]
    cells = measure(view, wanted, reference(view, FAST, 700), [])
    return {(cell.setting.max_depth, cell.setting.samples): cell for cell in cells}


@needs_llvm
def test_noise_falls_as_the_root_of_samples() -> None:
    """Independent samples: -1/2. Stratified ones are never worse, and fall faster by what they resolve of it.

    Fails with variances in place of their roots (-1.1), and with the same seed for all repeats (no noise at all).
    """
    noise = [_measured()[DEEPEST, n].errors.noise for n in (16, 64, 256)]
    # 1200 pixels, blurred: some 1200 / (4 pi 0.8²) = 150 independent values and 2 degrees of freedom each: noise within
    # 1 / sqrt(2 · 300) = 4 %, the slope over a factor of 16 within 0.04 sqrt(2) / ln 16 = 0.02; 4 times that above.
    # Below: a jittered grid over an edge has variance n^-3/2 (Mitchell 1996), and paths are only partly stratified.
    assert -0.75 < slope((16, 64, 256), noise) < -0.5 + 0.08


@needs_llvm
def test_full_paths_have_no_bias_and_cut_ones_are_seen() -> None:
    """A path of 2 is direct light only; here it lacks 1.2 % of the light.

    Fails with DEEPEST = 2: the reference then lacks it, too.
    """
    for n in (16, 64, 256):
        found = _measured()[DEEPEST, n].errors
        assert abs(found.bias_percent) < 4 * found.bias_se_percent
        assert found.systematic < 2 * found.systematic_limit  # the limit is two standard errors: four
    cut = _measured()[2, 64].errors
    assert cut.bias_percent < -10 * cut.bias_se_percent
    assert cut.systematic > 3 * cut.systematic_limit
    assert cut.rmse**2 == pytest.approx(cut.noise**2 + cut.systematic**2)  # the definition


def test_settings_differ_and_keep_below_the_reference() -> None:
    sensor = small_sensor(1.45, lights=LIGHTS)
    every, _ = variants("cpu", False)
    found = settings(every, sensor, 4, 1200)
    assert len(found) == len(set(found))
    assert max(setting.samples for setting in found) <= 200
    assert {setting.max_depth for setting in found} == {2, 3, 4, 6, DEEPEST}
    assert {s.variant.name for s in found if not s.window} == {variant.name for variant in every}
    assert all(setting.samples % 2 == 0 for setting in found)  # a multiple of the lights, as it is really taken


def test_another_size_keeps_what_the_camera_sees() -> None:
    """The mean signal stays: the same field of view, exposure and vignetting."""
    sensor = small_sensor(1.45, lights=LIGHTS, vignetting=0.5)
    small = resized(sensor, (40, 30))
    signals = [expected_signal(np.ones((c.height, c.width, 3), np.float32), c) for c in (sensor.camera, small.camera)]
    # The vignette is quadratic; its mean over pixels of twice the width differs by (1/80)² / 4 of 1/2 at most.
    assert signals[0].mean() == pytest.approx(signals[1].mean(), abs=1e-4)
    assert small.camera.fx / small.camera.width == sensor.camera.fx / sensor.camera.width


def test_jackknife_of_a_sum() -> None:
    """For values a_i + b_j it is exactly the standard error of the mean of a + b.

    Fails with the factor S - 1 forgotten, and with rows alone left out (half of it).
    """
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 7))
    expected = np.std(a + b, ddof=1) / 7**0.5
    assert jackknife(a[:, None] + b[None, :]) == pytest.approx(expected, rel=1e-12)


def test_verdicts_allow_for_two_standard_errors() -> None:
    assert is_unseen((-0.004, 0.003))
    assert not is_unseen((-0.004, 0.0031))
    assert not is_seen((-0.012, 0.001))
    assert is_seen((-0.0121, 0.001))


def test_dis_measures_the_forward_flow() -> None:
    """A texture that moves by 2 px to the right and 1 px up: forward flow (2, -1); a wrong sign would be 4 px off."""
    import cv2

    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (64, 80)).astype(np.uint8), (0, 0), 1.2)
    moved = np.roll(texture, (-1, 2), axis=(0, 1))
    inner = np.zeros((64, 80), dtype=bool)
    inner[8:-8, 8:-8] = True
    exact = Truth(np.broadcast_to([2.0, -1.0], (64, 80, 2)), inner)
    measured = dis(texture, moved)
    # DIS medium errs by some hundredths of a px on such textures (0.03 to 0.1 in the README's tables).
    assert exact.error_px(measured) < 0.2
    assert exact.typical_px(measured) < 0.1
    assert exact.error_px(np.zeros_like(exact.flow)) == exact.mean_px == pytest.approx(5**0.5)


def _cell(seconds: float, rmse: float, window: bool = True) -> Cell:
    return Cell(Setting(FAST, window, 2, 36), 2 * seconds, seconds, Errors(rmse, rmse, 0.0, 0.1, 0.0, 0.1))


def test_pareto_front() -> None:
    """A row that is slower and worse, and one of another picture, are not on it."""
    cells = [_cell(1.0, 3.0), _cell(2.0, 1.0), _cell(3.0, 2.0), _cell(0.1, 0.1, window=False)]
    assert pareto_front(cells) == cells[:2]


def test_auto_is_judged() -> None:
    choice = Choice(0, samples=900, fixed=36, seconds=1.0, camera=0.5, noise=0.12, fixed_noise=0.6)
    assert choice.met
    assert not replace(choice, noise=0.13).met  # 0.26, more than 3 % above a quarter
    assert not replace(choice, noise=0.2, samples=4096).met
    assert replace(choice, samples=4096).is_capped


@needs_llvm
def test_a_whole_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The tiny scene with a camera so noisy that "auto" needs few samples."""
    scene = write_tiny(tmp_path, TEXT.replace("read_noise = 0.002", "read_noise = 0.1"))
    out = tmp_path / "out"
    command = ["bench", "render", "--scene", str(scene), "--out", str(out), "--device", "cpu", "--json"]
    assert main([*command, "--size", "32x24", "--reference", "240", "--seeds", "3"]) == 0
    answer = json.loads(capsys.readouterr().out)
    cells = answer["cells"]
    assert {row["variant"] for row in cells} == {"llvm_ad_rgb", "scalar_rgb"}
    assert {row["window"] for row in cells} == {True, False}
    assert all(row["is_error"] == row["window"] for row in cells)
    assert all(row["seconds"] > 0 and row["processor_s"] > 0 for row in cells)
    # Without a window the radiance is not divided by n² = 2.1: another picture by far.
    assert all(row["rmse"] > 20 for row in cells if not row["window"])
    assert len(answer["checks"]) == 2
    assert all(answer["checks"].values())
    for row in answer["auto"]:
        assert row["share"] == pytest.approx(row["noise"] / row["camera"], abs=1e-4)
        assert row["share"] < 0.2575
    assert [row["load"] > 0 and row["build"] > 0 for row in answer["start_up"]] == [True, True]
    by_samples = {(row["samples"], row["camera_noise"]): row for row in answer["flow"]}
    assert len(by_samples) == len(answer["flow"]) == 8  # 15, 20, 80 and 195 samples, noise off and on
    with (out / "render.csv").open() as file:
        assert [float(line["rmse"]) for line in csv.DictReader(file)] == [row["rmse"] for row in cells]
    with (out / "render_flow.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 8 * 9
    errors_of = [float(line["error_px"]) for line in lines if (line["samples"], line["camera_noise"]) == ("80", "True")]
    assert np.median(errors_of) == pytest.approx(by_samples[80, True]["error_px"], abs=1e-6)
    # More render noise moves the measured flow farther from that without; a factor of 10 in samples.
    assert by_samples[15, False]["difference_px"] > by_samples[195, False]["difference_px"]
    text = (out / "render.md").read_text()
    assert "python -m synth bench render --scene tiny.toml --out DIR --size 32x24 --reference 240" in text
    assert all(part in text for part in ("## Answers", "## Without window", "## Start-up", "## Not covered", "cuda"))
    assert (out / "render.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "160"], "--size 160: give WIDTHxHEIGHT in px, each from 16 on"),
        (["--size", "8x8"], "--size 8x8: give WIDTHxHEIGHT in px, each from 16 on"),
        (["--seeds", "2"], "--seeds: it is '2', allowed are whole numbers from 3 on"),
        (["--reference", "1"], "--reference: it is '1', allowed are whole numbers from 64 on"),
        (["--scene", "nowhere"], "nowhere"),
    ],
)
def test_wrong_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str) -> None:
    assert main(["bench", "render", "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
