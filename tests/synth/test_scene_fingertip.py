"""The shipped scene with two layers: every draw is whole, its markers are matt, its coating shines."""

import numpy as np

from synth.optics import Optics
from synth.render.lights import check_view
from synth.render.pattern import albedo
from synth.scene.sampling import draw
from synth.scene.template import SCENES, load_scene


def test_every_draw_sees_gel_and_no_light_and_has_two_layers() -> None:
    """Fails with a light at x = 5 mm, a pad of 17 x 14 mm, and layer left out of the file."""
    template = load_scene("gelsight_fingertip")
    for trajectory in range(0, 20, 2):
        scene = draw(template, 3, trajectory)
        sensor = scene.sensor
        check_view(sensor)
        assert not sensor.coating.is_matt
        optics = Optics.of(sensor)
        u, v = np.linspace(0, sensor.camera.width, 9), np.linspace(0, sensor.camera.height, 9)
        rays = optics.look(np.array([(x, y) for x in u for y in v]))
        hits = rays.origins - rays.directions * (rays.origins[:, 2:] / rays.directions[:, 2:])
        shear = np.abs(scene.motion.shear_mm)  # gel moves less than its indenter
        assert np.all(np.abs(hits[:, :2]) + shear < np.array(sensor.gel.size_mm[:2]) / 2)
    texture = albedo(sensor, np.random.default_rng(0))
    assert texture.shape[2] == 4
    radius, (across, down) = sensor.pattern.radius_mm, sensor.pattern.spacing_mm
    # Some 280 dots, each 16 % off in area (radius_jitter 0.08): 1 %; up to 3 % of them cut by the pad's border.
    covered = texture[:, :, 3].mean() / (np.pi * radius**2 / (across * down))
    assert abs(covered - 1) < 0.06


def test_sources_and_simplifications_are_told() -> None:
    text = (SCENES / "gelsight_fingertip.toml").read_text()
    assert "# Simplified:" in text
    assert "assumed" in text
    assert len(draw(load_scene("gelsight_fingertip"), 0, 0).references) >= 2
