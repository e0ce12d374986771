"""The shipped scenes: every draw is valid, filled with gel, and says where its numbers come from."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from synth.optics import Optics
from synth.render.lights import check_view
from synth.render.pattern import pixels_per_mm
from synth.scene import Scene

FOLDER = Path(__file__).parents[2] / "scenes"
NAMES = ["gelsight_mini", "deltact", "gelsight"]


def _resolve(value, rng: np.random.Generator):
    """One draw from nested distributions, written for this test alone."""
    if isinstance(value, list):
        return [_resolve(item, rng) for item in value]
    if not isinstance(value, dict):
        return value
    if len(value) == 1:
        ((kind, of),) = value.items()
        if kind in ("uniform", "normal"):
            return float(getattr(rng, kind)(*of))
        if kind == "log_uniform":
            return float(np.exp(rng.uniform(*np.log(of))))
        if kind == "choice":
            return _resolve(of[rng.integers(len(of))], rng)
    return {key: _resolve(item, rng) for key, item in value.items()}


def _draws(name: str, count: int = 30) -> list[Scene]:
    raw = tomllib.loads((FOLDER / f"{name}.toml").read_text())
    return [Scene.model_validate(_resolve(raw, np.random.default_rng(seed))) for seed in range(count)]


@pytest.mark.parametrize("name", NAMES)
def test_every_draw_is_a_scene_whose_lights_stay_out_of_view(name: str) -> None:
    scenes = _draws(name)
    assert {scene.name for scene in scenes} == {name}
    for scene in scenes:
        check_view(scene.sensor)
    shapes = {scene.contact.indenter.shape for scene in scenes}
    assert shapes == {"sphere", "cylinder", "box", "cone", "torus"}  # 30 draws of 6 kinds miss one with p < 3 %; seeded


@pytest.mark.parametrize("name", NAMES)
def test_every_number_has_its_source(name: str) -> None:
    scene = _draws(name, 1)[0]
    assert len(scene.references) >= 2
    assert scene.description


@pytest.mark.parametrize("name", NAMES)
def test_no_pixel_looks_past_the_pad_even_when_it_is_sheared(name: str) -> None:
    """The borders' rays meet z = 0 at least the largest shear inside the pad."""
    raw = tomllib.loads((FOLDER / f"{name}.toml").read_text())
    shear = np.array([axis["uniform"][1] for axis in raw["motion"]["shear_mm"]])
    for scene in _draws(name):
        camera = scene.sensor.camera
        u, v = np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9)
        border = np.array([(x, y) for x in u for y in v if x in (0, camera.width) or y in (0, camera.height)])
        origins, directions = Optics.of(scene.sensor).rays(border)
        hits = origins - directions * (origins[:, 2:] / directions[:, 2:])
        assert np.all(np.abs(hits[:, :2]) + shear < np.array(scene.sensor.gel.size_mm[:2]) / 2)


@pytest.mark.parametrize("name", NAMES)
def test_motion_spans_a_fraction_of_a_pixel_to_25(name: str) -> None:
    shears = np.array([scene.motion.shear_mm for scene in _draws(name, 100)])
    motion = np.hypot(*shears.T) * pixels_per_mm(_draws(name, 1)[0].sensor)
    assert 15 < motion.max() < 35


def test_gelsight_mini_covers_the_published_field_of_view() -> None:
    """18.6 mm x 14.3 mm (datasheet); square pixels at 4:3 cannot meet both, so within 3 %."""
    sensor = _draws("gelsight_mini", 1)[0].sensor
    scale = pixels_per_mm(sensor)
    assert sensor.camera.width / scale == pytest.approx(18.6, rel=0.03)
    assert sensor.camera.height / scale == pytest.approx(14.3, rel=0.03)
    assert 30 < sensor.pattern.spacing_mm[0] * scale < 33  # px, measured in the recordings
    assert 10 < 2 * sensor.pattern.radius_mm * scale < 14.5
