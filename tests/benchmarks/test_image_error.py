"""The statistics of image errors, on made-up images whose errors are known."""

import numpy as np
import pytest
from render_scenes import small_sensor

from benchmarks.image_error import Halves, camera_noise, errors, reference_noise
from synth.arrays import Image
from synth.render import sample_count

LINEAR = small_sensor(gamma=1.0).camera


def images(count: int, deviation: float, offset: float = 0.0, seed: int = 0) -> list[Image]:
    """Images of 0.25 with independent Gaussian noise in every value."""
    rng = np.random.default_rng(seed)
    shape = (60, 80, 3)
    return [(0.25 + offset + deviation * rng.standard_normal(shape)).astype(np.float32) for _ in range(count)]


def halves(deviation: float, seed: int) -> Halves:
    """Of a reference."""
    first, second = images(2, deviation, seed=seed)
    return first, second


def test_errors_of_known_images() -> None:
    """Noise 0.01 in the images, 0.008 in each half of the reference, an offset of 0.004, full scale 255 levels."""
    reference = halves(0.008, 1)
    found = errors(images(4, 0.01, 0.004), reference, LINEAR)
    # 14400 values: a standard deviation is known within 1 / sqrt(2 · 14400) = 0.6 %, here of several; 4 times that.
    assert found["noise"] == pytest.approx(2.55, rel=0.024)
    assert reference_noise(reference, LINEAR) == pytest.approx(255 * 0.008 / 2**0.5, rel=0.024)
    assert found["rmse"] == pytest.approx(255 * (0.01**2 + 0.004**2) ** 0.5, rel=0.024)
    # systematic² = 1.04: its standard error, module's formula with channels as one: 0.084; of their being three, less.
    assert found["systematic"] ** 2 == pytest.approx(1.02**2, abs=4 * 0.084)
    assert found["systematic"] > found["systematic_limit"]
    # Bias: 1.6 %; the mean of 14400 values of 4 images and of the reference: sqrt(0.01²/4 + 0.008²/2) / 120 / 0.25.
    assert found["bias_percent"] == pytest.approx(1.6, abs=4 * 0.025)
    assert found["bias_se_percent"] == pytest.approx(0.025, rel=0.05)


@pytest.mark.parametrize("blur_px", [0.0, 4.0])
def test_standard_errors_hold_where_nothing_is_systematic(blur_px: float) -> None:
    """Of 60 made-up settings without offset the scores must scatter as their standard errors say."""
    camera = LINEAR.model_copy(update={"blur_px": blur_px})
    found = [errors(images(3, 0.01, seed=k), halves(0.01, 1000 + k), camera) for k in range(60)]
    # A standard deviation of 60 scores: within 1 ± 4 / sqrt(120).
    assert np.std([one["bias_percent"] / one["bias_se_percent"] for one in found]) == pytest.approx(1, abs=0.37)
    # Channels count as one though they are three: the limit is at 2 sqrt(3) standard errors, 0.03 % of the cases.
    assert sum(one["systematic"] > one["systematic_limit"] for one in found) <= 1


def test_measured_camera_noise_is_the_models() -> None:
    """A grey of 0.25, where noise of 0.02 is far from both ends of the scale, and 16 bits."""
    camera = small_sensor(gamma=1.0, shot_noise=0.04, bit_depth=16).camera
    grey = np.full((60, 80, 3), 0.25, dtype=np.float32)
    # 14400 values: 0.6 %, 4 times.
    assert camera_noise(grey, camera) == pytest.approx(255 * sample_count.camera_noise(grey, camera), rel=0.024)
