"""The rest map: on the images of a dataset and fixed to them, measured from frames at rest, or refused in one line."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import refused
from render_scenes import small_sensor
from tiny_scene import TEXT, reference, write_tiny

from synth.arrays import FloatArray
from synth.calibrate.comparison import Comparison
from synth.calibrate.rest_map import measured_rest_map, with_rest_map
from synth.dataset.images import encode_png
from synth.dataset.reader import read_dataset
from synth.pipeline.generate import generate
from synth.planning import check_buildable
from synth.render.camera_image import camera_image
from synth.render.pattern import is_grey
from synth.render.rest_map import read_rest_map
from synth.render.variant import choose_variant
from synth.scene.template import load_scene

CAMERA = small_sensor(rest_map="map.png", gamma=2.0, exposure=1.5).camera  # 80 x 60 px
ROWS, COLUMNS = CAMERA.height, CAMERA.width


def _smooth(height: int, width: int) -> FloatArray:
    """Factors (height, width, 3) from 0.7 to 1.3, another slope in each channel."""
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    return np.stack([1 + 0.3 * x, 1 + 0.3 * y, 1 - 0.3 * x * y], axis=2)


@pytest.mark.parametrize("kind", ["8 bits", "16 bits", "floats"])
def test_factors_multiply_the_linear_signal_before_the_noise(tmp_path: Path, kind: str) -> None:
    given = _smooth(ROWS, COLUMNS)
    if kind == "floats":
        given = np.repeat(given[:, :, :1], 3, axis=2)
        assert cv2.imwrite(str(tmp_path / "map.tiff"), given[:, :, 0].astype(np.float32))
    else:
        one = {"8 bits": 128, "16 bits": 32768}[kind]
        stored = np.round(given * one).astype(np.uint8 if one == 128 else np.uint16)
        (tmp_path / "map.png").write_bytes(encode_png(stored))
        given = stored / one
    camera = CAMERA.model_copy(update={"rest_map": "map.tiff"}) if kind == "floats" else CAMERA
    factors = read_rest_map(camera, tmp_path)
    assert np.abs(factors - given).max() < 1e-7  # float32
    grey = np.full((ROWS, COLUMNS, 3), 0.3, np.float32)
    seen = camera_image(grey, camera, np.random.default_rng(0), factors)
    exact = 255 * (1.5 * 0.3 * given) ** 0.5
    assert np.abs(seen - exact).max() <= 0.5 + 1e-4  # rounding to levels, and float32
    assert not is_grey(small_sensor(rest_map="map.png"))


def test_images_of_a_dataset_have_it_and_nothing_else_changes(tmp_path: Path, one_cache: None) -> None:
    """Dust of a factor of 0.5 stays at its pixels when the gel moves; scenes with other maps have other hashes."""
    scene = write_tiny(tmp_path, TEXT.replace("read_noise = 0.002", "read_noise = 0.0") + "common_draws = true\n")
    factors = np.full((24, 32, 3), 32768, np.uint16)
    factors[5:8, 20:24] //= 2
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps/unit.png").write_bytes(encode_png(factors))
    with (tmp_path / "mapped.toml").open("w") as file:
        file.write('extends = "tiny.toml"\nname = "tiny"\nsensor.camera.rest_map = "maps/unit.png"\n')
    plain, mapped = load_scene(scene), load_scene(tmp_path / "mapped.toml")
    for template, name in ((plain, "plain"), (mapped, "mapped")):
        generate(template, 1, tmp_path / name)
    (first,), (second,) = (list(read_dataset(tmp_path / name)) for name in ("plain", "mapped"))
    np.testing.assert_array_equal(first.forward, second.forward)
    dust = np.zeros((24, 32), bool)
    dust[5:8, 20:24] = True
    gamma = mapped.corners[0].sensor.camera.gamma
    for before, after in zip(first.images, second.images, strict=True):
        np.testing.assert_array_equal(before[~dust], after[~dust])
        # Half a level is rounded, before and after.
        assert np.abs(after[dust] - 0.5 ** (1 / gamma) * before[dust].astype(float)).max() < 1
    before = mapped.hash
    (tmp_path / "maps/unit.png").write_bytes(encode_png(factors // 2))
    assert load_scene(tmp_path / "mapped.toml").hash != before
    assert reference()  # the scene without a map


WRONG = np.full((ROWS, COLUMNS), 1, np.float32)
WRONG[3, 4] = -0.1
REFUSED = {
    "missing": (None, "cannot be read: No such file"),
    "text": (b"<svg/>", "no whole picture of 8 or 16 bits"),
    "of another size": (encode_png(np.ones((ROWS, 30), np.uint8)), r"has 30 x 60 pixels, the camera has 80 x 60; make"),
    "negative": (cv2.imencode(".tiff", WRONG)[1].tobytes(), "negative or not finite; allowed are 0 and above"),
    "not finite": (cv2.imencode(".tiff", np.float32(np.inf) * WRONG)[1].tobytes(), "negative or not finite"),
}


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_map_of_the_camera_is_refused_in_one_line(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "map.png"
    if content is not None:
        path.write_bytes(content)
    refused(rf"\Asensor\.camera\.rest_map: {re.escape(str(path))}.*{message}.*\Z", read_rest_map, CAMERA, tmp_path)


def test_a_job_refuses_a_missing_or_wrong_map_before_it_begins(tmp_path: Path) -> None:
    scene, change = write_tiny(tmp_path), f"sensor.camera.rest_map={tmp_path / 'map.png'}"
    refused(r"sensor\.camera\.rest_map: there is no file .*map\.png", load_scene, scene, [change])
    (tmp_path / "map.png").write_bytes(encode_png(np.ones((9, 9), np.uint8)))
    refused("has 9 x 9 pixels", check_buildable, load_scene(scene, [change]), choose_variant("cpu"))


def test_field_and_specks_are_measured_without_noise_and_dots() -> None:
    rng, gamma, (height, width) = np.random.default_rng(3), 2.2, (240, 320)
    field, outside = _smooth(height, width), np.ones((height, width), bool)
    specks = np.ones((height, width, 1))
    specks[50:54, 100:104], specks[180:183, 250:252] = 0.7, 1.4
    y, x = np.mgrid[:height, :width]
    dots = ((x % 40 - 20) ** 2 + (y % 40 - 20) ** 2 < 49)[:, :, None] & (specks == 1)
    outside = ~dots[:, :, 0]
    light = 0.2 + 0.1 * (x / width)[:, :, None] * np.ones(3)
    frame = np.where(dots, 0.02, light * field * specks)
    noisy = np.clip(frame + 0.002 * rng.standard_normal(frame.shape), 0, 1) ** (1 / gamma)
    row = Comparison(noisy, light ** (1 / gamma), outside)
    found = measured_rest_map(row, gamma)
    factors = found / 32768
    inside = slice(12, -12), slice(12, -12)  # two widths of a place from the border, where slopes are continued flat
    spots = specks[inside][:, :, 0] != 1
    away = np.abs(factors / (field * specks) - 1)[inside]
    # A place averages noise over 4 pi 6.4^2 px: 0.1 %; dots shift it by up to 3 px of a slope of 0.3 in 120 px: 1 %,
    # and so do specks, whose own pixels, and few others by chance, keep their noise of 0.002 / 0.14: 1.4 %.
    assert np.percentile(away[~spots], 99.9) < 0.02
    assert away.max() < 0.08
    mended = np.abs(with_rest_map(row, found, gamma).rendered - frame ** (1 / gamma))[inside]
    assert 255 * mended[outside[inside]].max() < 8
