"""The camera's sensor: levels, noise, blur and vignette against their formulas; how many samples its noise hides."""

import numpy as np
import pytest
from render_scenes import FAST, flat_surface, needs_llvm, plain, small_sensor

from synth.render.camera_image import (
    camera_image,
    camera_noise,
    expected_signal,
    needed_samples,
    render_noise,
    vignette,
)
from synth.render.renderer import Renderer, full_grid
from synth.scene import Light, Render


def _flat(value: float) -> np.ndarray:
    return np.full((150, 200, 3), value, dtype=np.float32)


def _camera(**fields):
    return small_sensor(**({"width": 200, "height": 150, "cx": 100.0, "cy": 75.0} | fields)).camera


def test_levels_follow_exposure_gamma_and_the_vignette_and_clip() -> None:
    camera = _camera(gamma=2.0, exposure=1.44)
    lit, overexposed = (camera_image(_flat(value), camera, np.random.default_rng(0)) for value in (0.25, 3.0))
    assert lit.dtype == np.uint8
    assert np.all(lit == round(255 * (0.25 * 1.44) ** 0.5))
    assert np.all(overexposed == 255)
    camera = _camera(vignetting=0.6, cx=50.5, cy=20.5)
    fall = vignette(camera)
    assert fall[20, 50] == 1
    assert fall.argmin() == fall.size - 1
    # The corner pixel's centre is half a pixel short of the corner itself.
    ratio = ((199.5 - 50.5) ** 2 + (149.5 - 20.5) ** 2) / ((200 - 50.5) ** 2 + (150 - 20.5) ** 2)
    assert fall[-1, -1] == pytest.approx(1 - 0.6 * ratio, rel=1e-12)
    assert np.allclose(expected_signal(_flat(0.5), camera)[:, :, 0], 0.5 * fall)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_deeper_images_fill_16_bits_in_steps_of_their_own(bits: int) -> None:
    ramp = np.linspace(0, 1, 150 * 200 * 3, dtype=np.float32).reshape(150, 200, 3)
    image = camera_image(ramp, _camera(gamma=1.0, bit_depth=bits), np.random.default_rng(0))
    assert (image.dtype, image.min(), image.max()) == (np.uint16, 0, 65535)
    levels = 2**bits - 1
    steps = image * (levels / 65535)
    assert np.abs(steps - np.round(steps)).max() <= 0.5 * levels / 65535 + 1e-9  # rounding to 16 bits


@pytest.mark.parametrize("signal", [0.1, 0.4])
def test_noise_has_the_photon_transfer_variance_and_comes_from_the_generator_alone(signal: float) -> None:
    camera = _camera(gamma=1.0, bit_depth=16, read_noise=0.01, shot_noise=0.05)
    first, again, other = (camera_image(_flat(signal), camera, np.random.default_rng(seed)) for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    image = first / 65535
    expected = 0.01**2 + 0.05**2 * signal
    # The variance of n = 90000 samples has the relative standard deviation sqrt(2 / n) = 0.5 %; four of those.
    assert image.var() == pytest.approx(expected, rel=0.02)
    assert image.mean() == pytest.approx(signal, abs=4 * np.sqrt(expected / image.size))


def test_blur_is_a_normalised_gaussian_and_the_same_in_every_channel() -> None:
    impulse = np.zeros((150, 200, 3), dtype=np.float32)
    impulse[75, 100] = 1
    blurred = expected_signal(impulse, _camera(blur_px=1.5))[:, :, 1]
    x = np.arange(200) - 100
    assert blurred.sum() == pytest.approx(1, rel=1e-6)
    # A sampled Gaussian of sigma >= 1 px keeps its second moment to 1e-7; cutting it at 4 sigma costs below 2e-3.
    assert (blurred.sum(0) * x**2).sum() == pytest.approx(1.5**2, rel=2e-3)
    camera = _camera(blur_px=0.8, vignetting=0.3)
    ramp = np.linspace(0, 1, 150 * 200, dtype=np.float32).reshape(150, 200, 1)
    grey, colour = (expected_signal(image, camera) for image in (ramp, np.repeat(ramp, 3, axis=2)))
    assert grey.shape == (150, 200, 1)
    np.testing.assert_array_equal(grey[:, :, 0], colour[:, :, 1])


@needs_llvm
@pytest.mark.parametrize(("shot_noise", "aperture"), [(0.01, 0.0), (0.02, 0.0), (0.02, 3.0)])
def test_auto_keeps_render_noise_below_a_quarter_of_the_cameras(shot_noise: float, aperture: float) -> None:
    lights = tuple(Light(position_mm=(x, 1.0, 3.0), size_mm=(3, 1), color=(1, 1, 1), power=400) for x in (-7.0, 7.0))
    camera = {"aperture_mm": aperture, "focus_mm": 15.0, "shot_noise": shot_noise, "bit_depth": 16}
    sensor = small_sensor(1.45, lights=lights, gamma=2.2, **camera)
    surface, render = flat_surface(sensor), Render(samples_per_pixel="auto", max_depth=2)
    renderer, again = (Renderer(sensor, render, surface, plain(), FAST) for _ in "12")
    first, second = (renderer.radiance(surface.material, seed) for seed in (11, 12))
    share = render_noise(first, second, sensor.camera) / camera_noise(first, sensor.camera)
    assert share <= 0.25 * 1.03  # Noise of 14400 values is known within 1 %; the pilots' as well
    # Not wasteful: stratified noise falls as 1 / samples at best, so that a pilot of 16 asks for n / 16 times too many.
    assert share >= 0.25 / (renderer.samples_per_pixel / 16) ** 0.5 / 1.5 or renderer.samples_per_pixel == 16
    assert again.samples_per_pixel == renderer.samples_per_pixel == full_grid(renderer.samples_per_pixel, 2)


def test_number_follows_from_the_pilots_noise_and_quantisation_is_noise_too() -> None:
    """White noise of standard deviation 0.01 on a signal of 0.25, gamma 1: n = 16 (0.01 / (0.25 · 0.02))² = 64."""
    camera = small_sensor(gamma=1.0, shot_noise=0.04, bit_depth=16).camera  # 0.04 · √0.25 = 0.02
    rng = np.random.default_rng(0)
    mean = np.full((60, 80, 3), 0.25, dtype=np.float32)
    first, second = (mean + np.float32(0.01) * rng.standard_normal(mean.shape, dtype=np.float32) for _ in "12")
    assert camera_noise(mean, camera) == pytest.approx(0.02, rel=1e-6)
    quantised = camera.model_copy(update={"shot_noise": 0.0, "bit_depth": 8})
    assert camera_noise(mean, quantised) == pytest.approx(1 / 255 / 12**0.5)
    # Two pictures of 14400 values: 2 % in the variance at three standard deviations, and 1 for rounding up.
    assert needed_samples(first, second, camera, 16) == pytest.approx(64, abs=3)


@pytest.mark.parametrize("level", [0.0, 0.002, 0.2])
def test_the_cameras_noise_is_that_of_its_photographs_in_the_dark_too(level: float) -> None:
    camera = small_sensor(read_noise=0.004, shot_noise=0.01, bit_depth=16).camera
    radiance = np.full((60, 80, 3), level, dtype=np.float32)
    photograph = camera_image(radiance, camera, np.random.default_rng(0)) / 65535
    # 14400 values: 0.6 % of a standard deviation; 15 nodes leave 5 % where the response has its corner at black.
    assert camera_noise(radiance, camera) == pytest.approx(photograph.std(), rel=0.06)
