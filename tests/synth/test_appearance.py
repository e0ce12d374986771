"""Scenes beside photographs of the sensors that they stand for, measured by the same functions."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from appearance import bright_dots, speckle
from render_scenes import needs_llvm

from synth.calibrate.run import middle, render_settings
from synth.mesh import flat_surface
from synth.render.camera_image import camera_image
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.variant import choose_variant
from synth.scene import Sensor
from synth.scene.template import load_scene, replaced
from synth.scene.validation import validated

PHOTOGRAPHS = Path(__file__).parents[3] / "shared/real/other_sensors"


@needs_llvm
@pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason="the photographs of real sensors are not here")
@pytest.mark.parametrize(
    ("scene", "folder", "measure"),
    [("tac3d_single", "tac3d", bright_dots), ("dmtac", "dmtac", speckle)],
    ids=["tac3d_single", "dmtac"],
)
def test_a_rendered_gel_measures_as_its_photographs_within_a_tenth(scene: str, folder: str, measure) -> None:
    template = load_scene(scene, [])
    sensor = validated(replaced(template.content["sensor"], middle), scene, Sensor, "sensor")
    surface, texture = flat_surface(sensor.gel.size_mm), albedo(sensor, np.random.default_rng(0))
    renderer = Renderer(sensor, render_settings(template), surface, texture, choose_variant("auto"))
    radiance = renderer.radiance(surface.material, 0)
    rendered = measure(camera_image(radiance, sensor.camera, np.random.default_rng(1)).astype(float))
    paths = sorted((PHOTOGRAPHS / folder).glob("*.png"))
    photographs = [measure(cv2.imread(str(path))[:, :, ::-1].astype(float)) for path in paths]
    for name, value in rendered.items():
        if name != "white":  # of the contact: the rendered gel is at rest
            photographed = float(np.mean([each[name] for each in photographs]))
            assert value == pytest.approx(photographed, rel=0.1, abs=0.5), name  # half a level of 255 is not seen
