"""A scene's bitmap: found beside the scene file, part of what the scene is, and checked before a job starts."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_scene import own_cache, write_tiny

from synth.dataset.reader import read_dataset
from synth.errors import InputError
from synth.generate import generate
from synth.plan import check_buildable
from synth.render.variant import choose_variant
from synth.template import load_scene

BITMAP = 'sensor.pattern={ kind = "bitmap", file = "art/mine.png", width_mm = 8 }'


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    (tmp_path / "art").mkdir()
    return write_tiny(tmp_path)


def _draw(scene: Path, picture: np.ndarray) -> None:
    assert cv2.imwrite(str(scene.parent / "art" / "mine.png"), picture)


def test_the_picture_lies_beside_the_scene_file(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails with the file looked for in the current directory."""
    own_cache(monkeypatch)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    picture = np.full((60, 80), 255, np.uint8)
    picture[:, :40] = 0  # the left half is black
    _draw(scene, picture)
    generate(load_scene(scene, [BITMAP, "sensor.camera.read_noise=0"]), 1, tmp_path / "out")
    image = read_dataset(tmp_path / "out").read(0).image1
    assert image[:, 2:14].max() < 10
    assert image[:, 18:30].mean() > 50


def test_another_picture_is_another_scene(scene: Path) -> None:
    hashes = []
    for grey in (100, 100, 101):
        _draw(scene, np.full((4, 4), grey, np.uint8))
        hashes.append(load_scene(scene, [BITMAP]).hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_missing_picture_is_told_when_the_scene_is_loaded(scene: Path) -> None:
    with pytest.raises(InputError) as caught:
        load_scene(scene, [BITMAP])
    assert str(caught.value) == f"{scene}: sensor.pattern.file: there is no file {scene.parent / 'art/mine.png'}"


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (BITMAP, "sensor.pattern.file: .*mine.png is no whole picture"),
        ("sensor.pattern.spacing_mm=[1, 0.05]", "sensor.pattern.spacing_mm = 0.05: .*at least"),
    ],
)
def test_what_cannot_be_painted_is_refused_before_the_job(scene: Path, override: str, message: str) -> None:
    (scene.parent / "art" / "mine.png").write_text("no picture")
    with pytest.raises(InputError, match=message) as caught:
        check_buildable(load_scene(scene, [override]), choose_variant("cpu"))
    assert str(caught.value).startswith(f"{scene}: sensor.pattern.")
