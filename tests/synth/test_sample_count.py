"""samples_per_pixel = "auto": the renderer's noise stays below a quarter of the camera's own, and no more is paid."""

import numpy as np
import pytest
from render_scenes import FAST, flat_surface, needs_llvm, plain, small_sensor

from synth.render.camera_image import camera_image
from synth.render.renderer import Renderer, full_grid
from synth.render.sample_count import camera_noise, needed_samples, render_noise
from synth.scene import Light, Render, Sensor


def _lit_from_two_sides(shot_noise: float) -> Sensor:
    lights = tuple(Light(position_mm=(x, 1.0, 3.0), size_mm=(3, 1), color=(1, 1, 1), power=400) for x in (-7.0, 7.0))
    return small_sensor(1.45, lights=lights, gamma=2.2, shot_noise=shot_noise, bit_depth=16)


@needs_llvm
@pytest.mark.parametrize("shot_noise", [0.01, 0.02])
def test_auto_keeps_render_noise_below_a_quarter_of_the_cameras(shot_noise: float) -> None:
    """Fails with a SHARE of 1, and with the pilots' own number taken for the answer."""
    sensor = _lit_from_two_sides(shot_noise)
    surface = flat_surface(sensor)
    renderer = Renderer(sensor, Render(samples_per_pixel="auto", max_depth=2), surface, plain(), FAST)
    first, second = (renderer.radiance(surface.material, seed) for seed in (11, 12))
    share = render_noise(first, second, sensor.camera) / camera_noise(first, sensor.camera)
    # Noise of 14400 values is known within 1 %; the pilots' as well.
    assert share <= 0.25 * 1.03
    # Not wasteful: stratified noise falls as 1 / samples at best, so that a pilot of 16 asks for n / 16 times too many.
    assert share >= 0.25 / (renderer.samples_per_pixel / 16) ** 0.5 / 1.5 or renderer.samples_per_pixel == 16
    again = Renderer(sensor, Render(samples_per_pixel="auto", max_depth=2), surface, plain(), FAST)
    assert again.samples_per_pixel == renderer.samples_per_pixel == full_grid(renderer.samples_per_pixel, 2)


def test_number_follows_from_the_pilots_noise() -> None:
    """White noise of standard deviation 0.01 on a signal of 0.25, gamma 1: n = 16 (0.01 / (0.25 · 0.02))² = 64."""
    camera = small_sensor(gamma=1.0, shot_noise=0.04, bit_depth=16).camera  # 0.04 · √0.25 = 0.02
    rng = np.random.default_rng(0)
    first, second = (
        np.float32(0.25) + np.float32(0.01) * rng.standard_normal((60, 80, 3), dtype=np.float32) for _ in "12"
    )
    assert camera_noise(np.full((60, 80, 3), 0.25, dtype=np.float32), camera) == pytest.approx(0.02, rel=1e-6)
    # Two pictures of 14400 values: 2 % in the variance at three standard deviations, and 1 for rounding up.
    assert needed_samples(first, second, camera, 16) == pytest.approx(64, abs=3)


def test_quantisation_is_noise_too() -> None:
    camera = small_sensor(gamma=1.0, bit_depth=8).camera
    assert camera_noise(np.full((60, 80, 3), 0.25, dtype=np.float32), camera) == pytest.approx(1 / 255 / 12**0.5)


@pytest.mark.parametrize("level", [0.0, 0.002, 0.2])
def test_the_cameras_noise_is_that_of_its_photographs(level: float) -> None:
    """In the dark, too. Fails with the response's slope at the darkest grey in place of the quadrature."""
    camera = small_sensor(read_noise=0.004, shot_noise=0.01, bit_depth=16).camera
    radiance = np.full((60, 80, 3), level, dtype=np.float32)
    photograph = camera_image(radiance, camera, np.random.default_rng(0)) / 65535
    # 14400 values: 0.6 % of a standard deviation; 15 nodes leave 5 % where the response has its corner at black.
    assert camera_noise(radiance, camera) == pytest.approx(photograph.std(), rel=0.06)
