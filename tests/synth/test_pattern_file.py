"""A scene's bitmap: found beside the scene file, part of what the scene is, and checked before a job starts."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_scene import TEXT, own_cache, write_tiny

from synth.dataset.reader import read_dataset
from synth.errors import InputError
from synth.pipeline.generate import generate
from synth.planning import check_buildable
from synth.render.variant import choose_variant
from synth.scene.template import load_scene

BITMAP = 'sensor.pattern={ kind = "bitmap", file = "art/mine.png", width_mm = 8 }'


DOTS = TEXT[TEXT.index('kind = "dots"') : TEXT.index("[sensor.camera]")]
HALF = np.where(np.arange(80) < 40, 0, 255).astype(np.uint8)[None].repeat(60, axis=0)
"""The left half is black."""


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user is in its folder."""
    own_cache(monkeypatch)
    (tmp_path / "art").mkdir()
    monkeypatch.chdir(tmp_path)
    return write_tiny(tmp_path)


def _draw(scene: Path, picture: np.ndarray) -> None:
    assert cv2.imwrite(str(scene.parent / "art" / "mine.png"), picture)


def _is_half_black(scene: Path, *overrides: str) -> bool:
    generate(load_scene(scene, [*overrides, "sensor.camera.read_noise=0"]), 1, scene.parent / "out")
    image = read_dataset(scene.parent / "out").read(0).image1
    return bool(image[:, 2:14].max() < 10 and image[:, 18:30].mean() > 50)


def test_the_picture_lies_beside_the_scene_file(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails with the file looked for in the current directory."""
    monkeypatch.chdir("/")
    _draw(scene, HALF)
    bitmap = TEXT.replace(DOTS, 'kind = "bitmap"\nfile = "art/mine.png"\nwidth_mm = 8\n')
    assert _is_half_black(write_tiny(scene.parent, bitmap))


def test_a_picture_given_by_set_lies_where_the_user_is(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails with the file looked for beside the scene."""
    _draw(scene, HALF)
    monkeypatch.chdir(scene.parent / "art")
    assert _is_half_black(scene, BITMAP.replace("art/", ""))


def test_another_picture_is_another_scene(scene: Path) -> None:
    hashes = []
    for grey in (100, 100, 101):
        _draw(scene, np.full((4, 4), grey, np.uint8))
        hashes.append(load_scene(scene, [BITMAP]).hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_missing_picture_is_told_when_the_scene_is_loaded(scene: Path) -> None:
    with pytest.raises(InputError) as caught:
        load_scene(scene, [BITMAP])
    assert str(caught.value) == (
        f"{scene} with --set sensor.pattern: sensor.pattern.file: there is no file {scene.parent / 'art/mine.png'}"
    )


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
    assert str(caught.value).startswith(f"{scene} with --set {override.partition('=')[0]}: sensor.pattern.")
