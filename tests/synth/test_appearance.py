"""Scenes beside photographs of the sensors that they stand for, measured by the same functions.

Pictures are (H, W, 3) RGB in levels of 255. Lengths are in px, levels encoded.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest
from render_scenes import needs_llvm

from synth.arrays import FloatArray
from synth.calibrate.run import middle, render_settings
from synth.mesh import rest_surface
from synth.render.camera_image import camera_image
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.variant import choose_variant
from synth.scene import Sensor
from synth.scene.template import load_scene, replaced
from synth.scene.validation import validated

PHOTOGRAPHS = Path(__file__).parents[3] / "shared/real/other_sensors"


def bright_dots(image: FloatArray) -> dict[str, float]:
    """Pitch and size of dots brighter than the coating, and the levels of both, of dots some 32 px apart."""
    green = cv2.GaussianBlur(image[:, :, 1], (0, 0), 1.0)
    low, high = np.percentile(green, [50, 99])  # of the coating and of the dots
    dots = (green > (low + high) / 2).astype(np.uint8)
    _, _, table, centres = cv2.connectedComponentsWithStats(dots)
    left, top, width, height, area = table.T
    whole = (left > 0) & (top > 0) & (left + width < image.shape[1]) & (top + height < image.shape[0]) & (area > 20)
    whole[0] = False
    arms = (centres[whole][:, None] - centres[whole][None]).reshape(-1, 2)
    along, across = np.abs(arms).T
    found = {
        "pitch x": np.median(along[(across < 0.3 * along) & (along < 50)]),
        "pitch y": np.median(across[(along < 0.3 * across) & (across < 42)]),
        "width": np.median(width[whole]),
        "height": np.median(height[whole]),
    }
    coating = cv2.dilate(dots, np.ones((7, 7), np.uint8)) == 0
    inside = cv2.erode(dots, np.ones((3, 3), np.uint8)) > 0
    for name, part in {"coating": coating, "dots": inside, "mean": np.ones_like(coating)}.items():
        found |= {f"{name} {channel}": image[part, i].mean() for i, channel in enumerate(("red", "green", "blue"))}
    return {name: float(value) for name, value in found.items()}


def speckle(image: FloatArray) -> dict[str, float]:
    """Distance (at the mean of the power spectrum), size (where the autocorrelation falls to one half), contrast
    (standard deviation over the mean) and level of grey speckle away from where the picture is clipped to white.
    """
    grey = image.mean(axis=2)
    clipped = cv2.GaussianBlur((grey > 240).astype(np.float64), (0, 0), 12) > 0.02
    side, step = 96, 32
    spectra, levels, contrasts = [], [], []
    for top in range(0, grey.shape[0] - side + 1, step):
        for left in range(0, grey.shape[1] - side + 1, step):
            part = (slice(top, top + side), slice(left, left + side))
            if clipped[part].any():
                continue
            tile = grey[part]
            fine = tile - cv2.GaussianBlur(tile, (0, 0), 16)
            levels.append(tile.mean())
            contrasts.append(fine.std() / tile.mean())
            taper = np.hanning(side)
            spectra.append(np.abs(np.fft.fft2(fine * taper[:, None] * taper)) ** 2 / fine.var())
    power = np.mean(spectra, axis=0)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side))
    near = np.fft.ifft2(power).real
    near /= near[0, 0]
    fall = (near[0, :20] + near[:20, 0]) / 2
    half = int(np.argmax(fall < 0.5))
    size = half - (0.5 - fall[half]) / (fall[half - 1] - fall[half])
    found = {"pitch": (power.sum() / (power * frequency).sum()), "size": size, "contrast": np.mean(contrasts),
             "level": np.mean(levels), "white": np.mean(grey >= 254)}  # fmt: skip
    return {name: float(value) for name, value in found.items()}


@needs_llvm
@pytest.mark.skipif(not PHOTOGRAPHS.is_dir(), reason="the photographs of real sensors are not here")
@pytest.mark.parametrize(
    ("scene", "folder", "measure"), [("tac3d_single", "tac3d", bright_dots), ("dmtac", "dmtac", speckle)]
)
def test_a_rendered_gel_measures_as_its_photographs_within_a_tenth(scene: str, folder: str, measure) -> None:
    template = load_scene(scene, [])
    sensor = validated(replaced(template.content["sensor"], middle), scene, Sensor, "sensor")
    surface, texture = rest_surface(sensor.gel), albedo(sensor, np.random.default_rng(0))
    renderer = Renderer(sensor, render_settings(template), surface, texture, choose_variant("auto"))
    radiance = renderer.radiance(surface.material, 0)
    rendered = measure(camera_image(radiance, sensor.camera, np.random.default_rng(1)).astype(float))
    paths = sorted((PHOTOGRAPHS / folder).glob("*.png"))
    photographs = [measure(cv2.imread(str(path))[:, :, ::-1].astype(float)) for path in paths]
    for name, value in rendered.items():
        if name != "white":  # of the contact: the rendered gel is at rest
            photographed = float(np.mean([each[name] for each in photographs]))
            assert value == pytest.approx(photographed, rel=0.1, abs=0.5), name  # half a level of 255 is not seen
