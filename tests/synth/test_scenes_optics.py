"""The shipped scenes with mirrors, fisheye lenses and several cameras: every draw is whole, in every camera."""

import re
from pathlib import Path

import numpy as np
import pytest

from synth.optics import Optics
from synth.render.lights import check_view
from synth.scene import Scene, Sensor
from synth.scene.sampling import draw
from synth.scene.template import SCENES, load_scene

NAMES = ["gelslim", "gelstereo", "tac3d", "fingervision", "digit", "omnitact", "soft_bubble"]
CAMERAS = {"gelstereo": ["right"], "omnitact": ["east", "west", "south", "north"]}
PATHS = {"gelslim": {1}, "tac3d": {0, 1, 2}}


def _draws(name: str, count: int = 8) -> list[Scene]:
    template = load_scene(name)
    return [draw(template, 3, trajectory) for trajectory in range(0, 2 * count, 2)]


def _centres(sensor: Sensor) -> np.ndarray:
    width, height = Optics.of(sensor).size
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("name", NAMES)
def test_every_pixel_of_every_camera_sees_gel_and_no_light(name: str) -> None:
    """Also when the gel is sheared as far as it may be: gel moves less than its indenter."""
    for scene in _draws(name):
        shear = np.abs(scene.motion.shear_mm)
        assert list(scene.sensor.views) == ["", *CAMERAS.get(name, [])]
        for sensor in scene.sensor.views.values():
            check_view(sensor)
            rays = Optics.of(sensor).look(_centres(sensor))
            assert set(rays.path) == PATHS.get(name, {0})
            hits = rays.origins - rays.directions * (rays.origins[:, 2:] / rays.directions[:, 2:])
            assert np.all(np.abs(hits[:, :2]) + shear < np.array(sensor.gel.size_mm[:2]) / 2)


@pytest.mark.parametrize("name", NAMES)
def test_sources_and_simplifications_are_told(name: str) -> None:
    scene = _draws(name, 1)[0]
    assert scene.name == name
    assert len(scene.references) >= 2
    text = (Path(SCENES) / f"{name}.toml").read_text()
    assert "# Simplified:" in text
    assert "assumed" in text
    if scene.sensor.mirrors:
        assert re.search(r"mirrors? takes? no part in the lighting", text.replace("\n# ", " "))


@pytest.mark.parametrize("name", NAMES)
def test_images_are_small_and_scales_plausible(name: str) -> None:
    """A tenth of a millimetre between two neighbouring points of the gel is between a half and two pixels."""
    for scene in _draws(name, 2):
        for sensor in scene.sensor.views.values():
            camera, optics = sensor.camera, Optics.of(sensor)
            assert camera.width * camera.height <= 320 * 240
            middle = optics.look(_centres(sensor))
            k = len(middle.path) // 2 + camera.width // 2
            at = middle.origins[k] - middle.directions[k] * (middle.origins[k, 2] / middle.directions[k, 2])
            pair = optics.project(np.array([at, at + np.array([0.1, 0.0, 0.0])]), int(middle.path[k]))
            assert 0.5 < np.linalg.norm(pair[1] - pair[0]) < 2.0


def test_the_stereo_pair_sees_height() -> None:
    """The middle of the pad is in both images; raising it by 1 mm changes the disparity as base and distance say."""
    left, right = (Optics.of(sensor) for sensor in _draws("gelstereo", 1)[0].sensor.views.values())
    x, y = np.meshgrid(np.linspace(-4, 4, 9), np.linspace(-3, 3, 7))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    disparity = []
    for height in (0.0, 1.0):
        raised = points + np.array([0.0, 0.0, height])
        seen = [camera.project(raised) for camera in (left, right)]
        assert all(camera.is_inside(pixels).all() for camera, pixels in zip((left, right), seen, strict=True))
        disparity.append((seen[0] - seen[1])[:, 0])
    # 1 mm under the window is 1 / 1.41 mm of apparent height; base 12 mm, distance 29.4 mm, f = 316 px: 3.1 px, for
    # rays along the axis. The cameras look 10 degrees askew: the cosine's square, and as much again from Snell's law.
    np.testing.assert_allclose(disparity[1] - disparity[0], 316 * 12 / 1.41 / 29.4**2, rtol=0.08)
