"""Calibration recovers what a synthetic frame was made with, and what it writes is a scene that generates."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
from commands import refused, said
from numpy.typing import NDArray
from PIL import ExifTags, Image
from render_scenes import FAST, needs_llvm, plain, small_sensor

from synth.arrays import FloatArray
from synth.calibrate.dot_grid import fit_dot_grid, grid_index, pattern_points
from synth.calibrate.dots import find_dots
from synth.calibrate.frames import Frames, read_frames
from synth.calibrate.irradiance import LightGeometry, LitGel
from synth.calibrate.noise import fit_noise
from synth.calibrate.profile import fit_profile
from synth.calibrate.run import MARK, start_sensor
from synth.calibrate.sensor_fit import SensorFit, fit_sensor
from synth.cli import main
from synth.mesh import rest_surface
from synth.optics import Optics
from synth.render.camera_image import camera_image
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.scene import Camera, Coating, Dots, Light, Render, Sensor, Vector3
from synth.scene.template import load_scene

CLIPS = Path(__file__).parents[3] / "shared/real/gelsight_mini/clips"
POWERS = np.array([[420.0, 80, 30], [60, 390, 90], [45, 120, 510]])


def _start(**coating: Any) -> Sensor:
    """Three white lights around a dotted pad of 12 x 9 mm at 160 x 120 px."""
    places = (7.0, 0.5, 3.0), (-4.0, 5.6, 4.0), (-3.5, -5.6, 2.5)
    lights = tuple(Light(position_mm=p, size_mm=(1.5, 0.6), color=(1, 1, 1), power=300) for p in places)
    pattern = Dots(kind="dots", spacing_mm=(1.6, 1.6), radius_mm=0.33, offset_mm=(0.2, 0.1), reflectance=(0.06,) * 3)
    view = {"width": 160, "height": 120, "fx": 265.0, "fy": 265.0, "cx": 80.0, "cy": 60.0, "gamma": 2.2}
    sensor = small_sensor(1.41, pattern, lights, vignetting=0.2, **view)
    return sensor.model_copy(update={"coating": Coating(**coating)}) if coating else sensor


def _truth(start: Sensor) -> Sensor:
    """The same sensor with other colours and powers, its lights some 0.5 mm off, and another grid, lens and noise."""
    rng = np.random.default_rng(1)
    lights = []
    for light, power in zip(start.lights, POWERS, strict=True):
        shift = 0.3 * rng.standard_normal(3)
        place = {key: tuple(np.add(getattr(light, key), shift)) for key in ("position_mm", "aim_mm")}
        lights.append(light.model_copy(update=place | {"power": power.max(), "color": tuple(power / power.max())}))
    grid = {"spacing_mm": (1.55, 1.62), "rotation_deg": 2.0, "offset_mm": (0.33, -0.2), "radius_mm": 0.3}
    pattern = start.pattern.model_copy(update=grid | {"reflectance": (0.1, 0.08, 0.05)})
    lens = {"vignetting": 0.35, "blur_px": 0.8, "distortion": (0.04, 0.0, 0.0, 0.0, 0.0)}
    camera = start.camera.model_copy(update=lens | {"read_noise": 0.002, "shot_noise": 0.005})
    return start.model_copy(update={"lights": tuple(lights), "pattern": pattern, "camera": camera})


def _frame(sensor: Sensor) -> FloatArray:
    """The undeformed gel's picture as an 8-bit camera gives it, in [0, 1]."""
    surface, texture = rest_surface(sensor.gel), albedo(sensor, np.random.default_rng(0))
    renderer = Renderer(sensor, Render(samples_per_pixel=144, max_depth=2), surface, texture, FAST)
    return camera_image(renderer.radiance(surface.material, 1), sensor.camera, np.random.default_rng(5)) / 255


def _fit(truth: Sensor, spacing_mm: float | None, steps: int) -> SensorFit:
    image = _frame(truth)
    return fit_sensor(_start(), Frames(image, image, 1 / 255), FAST, spacing_mm, steps)


@pytest.fixture(scope="module")
def recovered() -> tuple[Sensor, SensorFit]:
    truth = _truth(_start())
    return truth, _fit(truth, None, 20)


@needs_llvm
def test_colours_powers_and_places_of_displaced_lights_are_recovered(recovered: tuple[Sensor, SensorFit]) -> None:
    """Lights start 0.2 to 0.8 mm away. Measured: powers within 2.1 %, colours within 0.1 %, places within 0.05 mm."""
    truth, fit = recovered
    assert fit.lights.powers == pytest.approx(POWERS, rel=0.05)
    colour = POWERS / POWERS.max(axis=1, keepdims=True)
    assert np.array([light.color for light in fit.sensor.lights]) == pytest.approx(colour, rel=0.01)
    places = np.array([light.position_mm for light in truth.lights])
    assert fit.lights.geometry.centre == pytest.approx(places, abs=0.15)


@needs_llvm
def test_dots_are_predicted_within_a_tenth_of_a_pixel(recovered: tuple[Sensor, SensorFit]) -> None:
    index = np.stack(np.meshgrid(np.arange(-9, 10), np.arange(-9, 10)), axis=-1).reshape(-1, 2)
    sensors = recovered[0], recovered[1].sensor
    true, found = (Optics.of(sensor).project(pattern_points(sensor.pattern, index)) for sensor in sensors)
    true = true[((true > 6) & (true < [154, 114])).all(axis=1)]
    assert len(true) > 30
    away = np.linalg.norm(true[:, None] - found[None], axis=2).min(axis=1)
    assert away.max() < 0.1


@needs_llvm
def test_dots_blur_vignetting_and_noise_are_recovered(recovered: tuple[Sensor, SensorFit]) -> None:
    truth, fit = recovered
    camera, pattern = fit.sensor.camera, fit.sensor.pattern
    assert pattern.radius_mm == pytest.approx(0.3, rel=0.03)  # the texture's soft edge is at least a texel, 0.03 mm
    assert pattern.reflectance == pytest.approx(truth.pattern.reflectance, abs=0.01)
    assert camera.blur_px == pytest.approx(0.8, abs=0.1)
    assert camera.vignetting == pytest.approx(0.35, abs=0.03)  # shares its shape with the lights' own fall-off
    # Four standard errors of a variance from some 8000 pixels in 36 bands, and rendering noise on top of the camera's.
    assert camera.read_noise == pytest.approx(0.002, rel=0.25)
    assert camera.shot_noise == pytest.approx(0.005, rel=0.25)


@needs_llvm
def test_a_known_spacing_gives_the_focal_length() -> None:
    fit = _fit(_truth(_start()), 1.55 * 1.1, 0)
    # The same dots 10 % farther apart are seen by a lens that is 10 % shorter.
    assert fit.sensor.camera.fx == pytest.approx(265 / 1.1, rel=2e-3)
    assert fit.sensor.pattern.spacing_mm == pytest.approx((1.55 * 1.1, 1.62 * 1.1), rel=2e-3)


def _every(step: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    columns, rows = np.meshgrid(np.arange(2, 160, step), np.arange(2, 120, step))
    return columns.ravel(), rows.ravel()


@needs_llvm
@pytest.mark.parametrize("angle", [120.0, 50.0])
@pytest.mark.parametrize("coating", [{}, {"roughness": 0.5, "metallic": 0.6}], ids=["matt", "metallic"])
@pytest.mark.parametrize("shade", [((-3.0, 4.8, 2.2), 0.6), ((-3.2, 4.6, 5.2), 2.0)], ids=["light", "its image"])
def test_contributions_are_what_the_renderer_renders(
    coating: dict[str, float], angle: float, shade: tuple[Vector3, float]
) -> None:
    """They share Mitsuba's BSDF and the rays, not the integral."""
    sensor = _start(**coating)
    light = sensor.lights[1].model_copy(update={"power": 200.0, "size_mm": (3.0, 0.5), "viewing_angle_deg": angle})
    dark = light.model_copy(update={"position_mm": shade[0], "size_mm": (3.0, shade[1]), "power": 1e-9})
    sensor = sensor.model_copy(update={"lights": (light, dark)})  # the second shades a part of the first's
    surface = rest_surface(sensor.gel)
    render = Render(samples_per_pixel=256, max_depth=2 if coating else 3)  # a matt gel lights itself by the window
    image = Renderer(sensor, render, surface, plain(), FAST).radiance(surface.material, 0)
    columns, rows = _every(8)
    gel = LitGel(sensor, np.column_stack([columns, rows]) + 0.5, FAST)
    lit = 200 * gel.contributions(LightGeometry.of(sensor.lights))[0]
    # Half of 256 samples, stratified, leave some 1 % at a pixel and 0.1 % in the mean over 300 pixels. The shade, 20 %
    # of the light, has an edge that the light's 24 cells resolve in steps of 4 %: below 1 % of the mean remains.
    assert lit.mean(axis=0) == pytest.approx(image[rows, columns].mean(axis=0), rel=0.012)
    assert np.median(np.abs(lit / image[rows, columns] - 1)) < 0.02


@needs_llvm
def test_a_matt_gel_is_lit_by_itself_by_way_of_the_window() -> None:
    """The renderer samples the paths whose integral is taken here: what a third surface adds to two."""
    thin = {"thickness_mm": 1.2, "refractive_index": 2.0}  # total reflection beyond 30 degrees
    window = _start().window.model_copy(update=thin)
    bright, dim = (_start(reflectance=(value,) * 3).model_copy(update={"window": window}) for value in (0.9, 0.45))
    surface, (columns, rows) = rest_surface(bright.gel), _every(8)
    renders = (Render(samples_per_pixel=64, max_depth=depth, light="separated") for depth in (2, 3))
    pictures = (Renderer(bright, one, surface, plain(0.9), FAST).radiance(surface.material, 0) for one in renders)
    direct, both = (picture[rows, columns, 0].mean() for picture in pictures)
    pixels, lights = np.column_stack([columns, rows]) + 0.5, LightGeometry.of(bright.lights)
    lit = [300 * LitGel(sensor, pixels, FAST).contributions(lights).sum(axis=0).mean() for sensor in (bright, dim)]
    # Direct light goes as the reflectance, what comes back as its square; shade on the images is left out: 3 %.
    assert both > 1.1 * direct
    assert 2 * (lit[0] - 2 * lit[1]) == pytest.approx(both - direct, rel=0.05)


@needs_llvm
@pytest.mark.parametrize("index", [1.0, 1.41])
def test_derivatives_agree_with_finite_differences(index: float) -> None:
    start = _start()
    sensor = start.model_copy(update={"window": start.window.model_copy(update={"refractive_index": index})})
    gel, geometry = LitGel(sensor, np.column_stack(_every(16)) + 0.5, FAST), LightGeometry.of(sensor.lights)
    geometry = replace(geometry, viewing_angle_deg=np.array([[119.0], [60.0], [30.0]]))
    exact = gel.derivatives(geometry)
    step = 0.02
    parts = (("centre", 3), ("direction", 3), ("size", 2), ("viewing_angle_deg", 1))
    for number, (name, axis) in enumerate((name, axis) for name, count in parts for axis in range(count)):
        moves = (sign * step * np.eye(getattr(geometry, name).shape[1])[axis] for sign in (1, -1))
        more, less = (gel.contributions(replace(geometry, **{name: getattr(geometry, name) + m})) for m in moves)
        difference = (more - less) / (2 * step)
        # Central differences err by step² / 6 times a third derivative of order E / (3 mm)³: 2e-5; float32 less.
        error = np.abs(exact[:, number] - difference) / np.abs(exact).max()
        # A window's reflectance rises with infinite slope at the critical angle, in one or two of a light's 24 cells.
        assert (error if index == 1 else np.percentile(error, 80)).max() < 3e-3


@needs_llvm
def test_the_command_writes_a_scene_that_loads_and_generates(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    preset = tmp_path / "preset.toml"
    preset.write_text(tomli_w.dumps(_preset()))
    frame, other = tmp_path / "frame.png", tmp_path / "other.png"
    for path in (frame, other):
        cv2.imwrite(str(path), np.round(255 * _frame(_truth(_start())))[:, :, ::-1])
    out = tmp_path / "mine"
    command = ["calibrate", "--scene", str(preset), "--frames", str(frame), "--judge", str(other), "--out", str(out)]
    record = json.loads(said(capsys, main, *command, "--steps", 0, "--json"))
    assert record == json.loads((out / "calibration.json").read_text())
    told = said(capsys, main, *command, "--steps", 6, "--rest-map")  # in place of the first
    assert "verdict: good; residual" in told
    assert "other.png, with the rest map: mean absolute difference" in told
    record = json.loads((out / "calibration.json").read_text())
    assert (record["verdict"]["good"], record["verdict"]["reasons"]) == (True, [])
    rows = {"frames", "not fitted: other.png"}
    assert set(record["differences"]) == rows | {f"{name}, with the rest map" for name in rows}
    for difference in record["differences"].values():
        # The fit itself leaves below 0.5; rounding to 8 bits and the camera's noise of 1 level, 0.8 on average.
        assert max(difference["mean_absolute_outside_dots"]) < 2
    assert cv2.imread(str(out / "calibration.png")) is not None
    fitted = load_scene(out / "scene.toml")
    assert fitted.corners[0].contact.indenter.radius_mm == 2.0  # what no frame tells keeps its distribution
    assert fitted.content["contact"]["indenter"]["radius_mm"] == {"uniform": [2.0, 3.0]}
    assert fitted.corners[0].sensor.camera.rest_map == "rest_map.png"
    said(capsys, main, "generate", "--scene", out / "scene.toml", "--n", 1, "--out", tmp_path / "data")


def _preset() -> dict:
    return {
        "name": "preset",
        "sensor": _start().model_dump(mode="json", exclude={"further_cameras", "mirrors"}, exclude_none=True),
        "contact": {"indenter": {"shape": "sphere", "radius_mm": {"uniform": [2.0, 3.0]}}},
        "motion": {"depth_mm": 0.2, "steps": 1},
        "render": {"samples_per_pixel": 36, "max_depth": 2},
        "numerics": {"element": "p1p1", "edge_length_mm": 1.5},
        "sampling": {"pairs_per_trajectory": 1},
    }


def test_frames_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    dark, bright = rng.integers(0, 99, (30, 40, 3)), rng.integers(100, 255, (30, 40, 3))
    for name, image in {"a": dark, "b": bright, "c": np.zeros((20, 40, 3))}.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image.astype(np.uint8))
    (tmp_path / "text.png").write_text("no image")
    for names, message in (
        ("ab", r"a\.png: half of it differs .* median by .* of 255"), ("ac", r"c\.png: has 40 x 20 pixels"),
        (["text"], r"text\.png is no whole picture"), (["missing"], r"missing\.png: cannot be read"), ([], "no frames"),
    ):  # fmt: skip
        refused(message, read_frames, [tmp_path / f"{name}.png" for name in names])


def test_frames_together_are_the_mean_of_those_that_are_not_pressed(tmp_path: Path) -> None:
    """Three frames of levels near their median, 102; the brightest has a contact."""
    for level in (100, 102, 107):
        image = np.full((120, 160, 3), level, np.uint8)
        if level == 107:
            image[40:80, 20:60] += 60
        cv2.imwrite(str(tmp_path / f"{level}.png"), image)
    together = 255 * read_frames(sorted(tmp_path.glob("*.png"))).encoded
    np.testing.assert_allclose(together[60, 40], 101)
    np.testing.assert_allclose(together[60, 120], 103)


def test_a_photograph_is_turned_as_its_exif_says(tmp_path: Path) -> None:
    stored = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # to be turned by a quarter, clockwise
    Image.fromarray(stored).save(tmp_path / "a.png", exif=exif)
    np.testing.assert_allclose(255 * read_frames([tmp_path / "a.png"]).single, np.rot90(stored, -1), atol=1e-9)


def test_a_frame_without_dots_dots_without_a_grid_and_dots_of_a_pixel_are_refused() -> None:
    refused("0 whole dots", find_dots, np.full((120, 160, 3), 0.3), 15.0)
    refused("grid", grid_index, np.random.default_rng(0).uniform(0, 100, (12, 2)))
    y, x = np.mgrid[:48, :64] + 0.5
    away = np.hypot(*((part + 2) % 5 - 2.5 for part in (x, y)))
    for radius in (0.5, 0.9):
        frame = np.repeat(0.5 * np.clip(away - radius + 0.5, 0.1, 1)[..., None], 3, axis=2)
        refused(r"radius of .* px, needed is more than 1 px", lambda f: fit_profile(find_dots(f, 5.0)), frame)


@pytest.mark.parametrize(
    ("first", "message"),
    [("", r"scene.toml: exists and does not come from"), (f"# {MARK} before`.\n", "is what --scene starts from")],
    ids=["another's", "a calibration's"],
)
def test_calibration_replaces_no_other_scene(tmp_path: Path, refusal: Callable, first: str, message: str) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(first + tomli_w.dumps(_preset()))
    before = scene.read_bytes()
    assert message in refusal("--scene", str(scene))
    assert scene.read_bytes() == before


@pytest.fixture
def refusal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """What the command says when it refuses a frame, by default a black one."""

    def refuse(*options: str, frame: FloatArray | None = None) -> str:
        path, image = str(tmp_path / "frame.png"), np.zeros((24, 32, 3)) if frame is None else frame
        cv2.imwrite(path, image.astype(np.uint8))
        return said(capsys, main, "calibrate", "--frames", path, "--out", tmp_path, *options, status=2)

    return refuse


@pytest.mark.parametrize("spacing", ["-3", "nan", "0", "0.1", "100", "inf"])
def test_a_spacing_that_no_dots_have_is_refused(refusal: Callable[..., str], spacing: str) -> None:
    assert f"--spacing-mm = {spacing}: must be from 0.475 to 7.6 mm" in refusal(f"--spacing-mm={spacing}")
    assert "has no dots" in refusal("--scene", "digit", "--spacing-mm=1")


@needs_llvm
@pytest.mark.parametrize(
    ("level", "message"),
    [(0, "are the frames black"), (255, "overexposed"), (None, "they give sensor.camera.shot_noise = ")],
)
def test_frames_that_tell_nothing_of_the_lights_are_refused(refusal: Callable, level: int | None, message: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3))
    frame = noise if level is None else np.full((60, 80, 3), level)
    options = ["--scene", "digit", "--steps", "0", "--set", "render.samples_per_pixel=1"]
    words = refusal(*options, frame=frame)
    assert message in words
    assert "scene.toml" not in words


@pytest.mark.parametrize(("preset", "message"), [("deltact", "sensor.pattern.kind"), ("gelslim", "without mirrors")])
def test_a_preset_that_calibration_does_not_know_is_refused(refusal: Callable, preset: str, message: str) -> None:
    assert message in refusal("--scene", preset)


def test_noise_is_measured_through_the_response() -> None:
    noise = {"gamma": 2.2, "read_noise": 0.002, "shot_noise": 0.012}
    camera = Camera(width=320, height=240, fx=1, fy=1, cx=0, cy=0, position_mm=(0, 0, 1), **noise)
    ramp = np.linspace(0.02, 0.6, 320, dtype=np.float32)[None, :, None] * np.ones((240, 1, 3), dtype=np.float32)
    image = camera_image(ramp, camera, np.random.default_rng(0)) / 255
    read, shot = fit_noise(image, np.ones((240, 320), dtype=bool), 2.2, 1 / 255)
    # Each of 36 bands of 6000 pixels knows its variance within 4 % (median, kernel's correlations): 1 % for the slope.
    assert shot == pytest.approx(0.012, rel=0.05)
    assert read == pytest.approx(0.002, rel=0.25)  # a few per cent of the variance in all but the darkest bands


@needs_llvm
@pytest.mark.skipif(not CLIPS.is_dir(), reason="the real recordings are not here")
def test_a_real_frame_that_was_not_fitted_is_met_within_4_levels(tmp_path: Path) -> None:
    """Undeformed gels after the object was lost; measured 3.7, 1.8 and 3.6 of 255."""
    for name, number in [("screw_driver_red__exp_num_2__camera_0", 344), ("avocado_real__exp_num_7__camera_0", 408)]:
        cv2.imwrite(str(tmp_path / f"{number}.png"), _real_frame(name, number))
    frames = ["--frames", str(tmp_path / "344.png"), "--judge", str(tmp_path / "408.png")]
    assert main(["calibrate", *frames, "--out", str(tmp_path / "out")]) == 0
    differences = json.loads((tmp_path / "out/calibration.json").read_text())["differences"]
    assert max(differences["not fitted: 408.png"]["mean_absolute_outside_dots"]) <= 4


@pytest.mark.skipif(not CLIPS.is_dir(), reason="the real recordings are not here")
@pytest.mark.parametrize("name", ["cellotape__exp_num_3__camera_0", "screw_driver_blue_gray__exp_num_7__camera_2"])
def test_real_dots_tell_the_lens_of_gelsight_mini(name: str) -> None:
    """One frame overrules a preset without distortion; its k1 is the scene's within two of that one's deviations."""
    shipped = start_sensor(load_scene("gelsight_mini"), (320, 240))
    camera = shipped.camera.model_copy(update={"distortion": (0.0,) * 5})
    straight = shipped.model_copy(update={"camera": camera})
    dots = find_dots((_real_frame(name, 449) / 255.0) ** camera.gamma, 32.0)
    found = fit_dot_grid(straight, straight.pattern, dots.centres, None)
    assert found.camera.distortion[0] == pytest.approx(shipped.camera.distortion[0], abs=0.02)
    assert np.sqrt((found.residual_px**2).sum(axis=1).mean()) < 0.6  # 1.2 without distortion


def _real_frame(name: str, number: int) -> NDArray[np.uint8]:
    clip = cv2.VideoCapture(os.fspath(CLIPS / f"{name}.avi"))
    for _ in range(number + 1):
        image = clip.read()[1]
    return image
