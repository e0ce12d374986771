"""One picture at rest and what is said of its light: too bright, too dark, flat, fine."""

import json
import re
from functools import partial
from pathlib import Path

import commands
import cv2
import numpy as np
import OpenEXR
import pytest
from samples import tree
from tiny_scene import LIGHTS, SENSOR, reference, write_tiny

from synth.cli import main
from synth.dataset.images import read_png
from synth.render.exposure import advice, levels_of
from synth.scene import Camera

ALL = np.ones((60, 80), dtype=bool)
GRADIENT = np.tile(np.linspace(40, 200, 80), (60, 1)).astype(np.uint8)


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    return partial(commands.said, capsys, main, "preview", "--out", tmp_path / "p.png", "--scene")


def test_the_picture_is_the_first_of_a_dataset(said, tiny: Path, tmp_path: Path, one_cache: None) -> None:
    """To the bit, the camera's noise included."""
    out = said(tiny)
    assert re.match(r"main, red: mean 47.\d% of white; pixels at white 0.0%, dark \(below 5% of white\) 0.0%\n", out)
    assert "\nmain: light suits the camera\n" in out
    assert re.search(r"^4\.48 px per mm on the gel: .*p\.png$", out, re.MULTILINE)
    np.testing.assert_array_equal(read_png(tmp_path / "p.png"), read_png(reference() / "samples/000000/image1.png"))


def test_places_are_where_pixels_see_the_gel(said, tiny: Path, tmp_path: Path) -> None:
    """Without a window's refraction, a camera 20 mm above the face sees it 20 mm / 82 px times as large."""
    places = tmp_path / "places.exr"
    straight = ["--set", "sensor.window.refractive_index=1.0", "--set", "sensor.camera.cx=16.0"]
    said(tiny, "--places", places, *straight)
    with OpenEXR.File(str(places), separate_channels=True) as file:
        found = {name: channel.pixels for name, channel in file.channels().items()}
    row, column = np.indices((24, 32)) + 0.5
    # float32 of some mm
    np.testing.assert_allclose(found["place.X"], (column - 16) * 20 / 82, atol=1e-5)
    np.testing.assert_allclose(found["place.Y"], (row - 12) * 20 / 82, atol=1e-5)
    np.testing.assert_allclose(found["place.Z"], 0, atol=1e-5)
    said(tiny, "--places", places, *straight)  # its own is replaced


@pytest.mark.parametrize(("exposure", "words"), [
    (50.0, r"clipped: 9\d % of the gel's pixels are at white in (red|green|blue); "),
    (1e-3, r"dark: the brightest per cent of the gel's pixels is at \d % of white; "),
])  # fmt: skip
def test_light_is_mended_by_what_is_advised(said, tmp_path: Path, exposure: float, words: str) -> None:
    """By either of two ways; all draws are common, so that they change the light alone."""
    scene = write_tiny(tmp_path)
    common = ["--set", "sampling={common_draws=true}", "--set"]
    out = said(scene, *common, f"sensor.camera.exposure={exposure}")
    told = re.search(rf"main: {words}multiply the power of all sensor.lights by (\S+), or give --set (\S+): ", out)
    assert told, out
    *_, factor, assignment = told.groups()
    assert float(assignment.partition("=")[2]) == pytest.approx(exposure * float(factor), rel=1e-2)  # of 3 digits each
    power = f"sensor.lights={lights(100 * float(factor))}"
    for change in ([assignment], [f"sensor.camera.exposure={exposure}", "--set", power]):
        found = json.loads(said(scene, *common, *change, "--json"))["cameras"]["main"]
        # Of 768 pixels: read noise moves the quantile by up to 1 %, its place among 8 pixels by as much again; powers
        # are drawn within 10 %, levels within 5 %.
        assert max(one["bright"] for one in found["levels"].values()) == pytest.approx(0.85, abs=0.05)
        assert found["advice"] == ""


def lights(power: float) -> str:
    """The tiny scene's lights with one power, as TOML."""
    tables = LIGHTS.replace("{ uniform = [90.0, 110.0] }", str(power)).split("[[sensor.lights]]")[1:]
    return "[" + ", ".join("{" + ", ".join(table.strip().splitlines()) + "}" for table in tables) + "]"


def test_a_scene_without_light_has_a_picture_and_a_word(said, tmp_path: Path) -> None:
    """The light's back is turned to the gel, and the window sends nothing back."""
    away = "[[sensor.lights]]\nposition_mm = [3.8, 0.0, 2.0]\naim_mm = [3.8, 0.0, 9.0]\nsize_mm = [0.3, 0.3]\n"
    scene = tmp_path / "night.toml"
    end = "color = [1, 1, 1]\npower = 10.0\n[contact.indenter]\nshape = 'sphere'\nradius_mm = 2.0\n"
    end += "[motion]\ndepth_mm = 0.1\n"
    scene.write_text(SENSOR.replace("window.thickness_mm = 3.0", "window.refractive_index = 1.0") + away + end)
    assert "main: dark: no light reaches the gel that the camera sees; check places and aims" in said(scene)
    assert (tmp_path / "p.png").exists()


def test_pictures_of_cameras_stand_side_by_side(said, tmp_path: Path) -> None:
    out = said("gelstereo", "--set", "render.samples_per_pixel=1")
    assert re.findall(r"^(\w+): light suits the camera$", out, re.MULTILINE) == ["main", "right"]
    assert read_png(tmp_path / "p.png").shape == (180, 2 * 240, 3)


@pytest.mark.parametrize(("image", "found"), [
    (GRADIENT, ""),
    (np.stack([GRADIENT, GRADIENT // 4, GRADIENT // 4], axis=-1), ""),  # one channel is enough
    (np.uint16(257) * GRADIENT, ""),
    (GRADIENT // 2, "dark: the brightest per cent of the gel's pixels is at 39 % of white"),
    (np.full_like(GRADIENT, 128), "flat: levels on the gel spread by 0.0 % of white"),
    (np.where(np.arange(80) < 8, np.uint8(255), GRADIENT), "clipped: 10 % of the gel's pixels are at white in grey"),
    (cv2.circle(GRADIENT.copy(), (40, 30), 1, 255, -1), ""),
    (np.where((np.indices((60, 80)) % 4 < 2).all(axis=0), np.uint8(255), GRADIENT), ""),  # white dots are no white area
], ids=["fine", "one channel", "16 bits", "dark", "flat", "clipped", "glint", "dots"])  # fmt: skip
def test_what_is_said_of_a_picture(image: np.ndarray, found: str) -> None:
    camera = Camera(width=80, height=60, fx=80, fy=80, cx=40, cy=30, position_mm=(0, 0, 20), gamma=1, exposure=0.25)
    light = np.full((60, 80, 3), 6.8, np.float32)  # twice what puts all of the gel at 85 % of white
    told = advice(levels_of(image, ALL), light, ALL, camera)
    assert told.partition("; ")[0] == found
    assert ("by 0.5, or give --set sensor.camera.exposure=0.125:" in told) is found.startswith(("clipped", "dark"))
    half = ALL & (np.arange(80) >= 8)  # nothing is said of what is no gel
    assert "clipped" not in advice(levels_of(image, half), light, half, camera)


def test_levels_are_shares_of_what_is_gel() -> None:
    image = np.zeros((60, 80), np.uint8)
    image[:, 40:], image[:, 79] = 51, 255
    one = levels_of(image, ALL & (np.arange(80) >= 20))["grey"]
    assert (one["bright"], one["clipped"], one["dark"]) == (1.0, round(1 / 60, 4), round(1 / 3, 4))
    assert one["mean"] == pytest.approx((39 * 0.2 + 1) / 60, abs=1e-4)  # rounded, as all of them
    assert one["spread"] == pytest.approx(np.sqrt((39 * 0.2**2 + 1) / 60 - one["mean"] ** 2), abs=1e-4)


def test_a_file_of_somebody_else_stays(capsys, tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "p.png"
    cv2.imwrite(str(out), GRADIENT)
    before = tree(tmp_path)
    words = commands.complaint(capsys, main, "preview", "--scene", tiny, "--out", out)
    assert "p.png: exists and does not come from this command" in words
    assert tree(tmp_path) == before
