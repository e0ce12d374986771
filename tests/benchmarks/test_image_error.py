"""The statistics of render noise on made-up images: known errors of images, and what noise changes in a flow."""

import numpy as np
import pytest
from render_scenes import small_sensor

from benchmarks.flow_change import Truth, changes, jackknife
from benchmarks.image_error import Halves, camera_noise, errors, reference_noise
from benchmarks.render import others
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


CAMERA = small_sensor(read_noise=0.0, shot_noise=0.0, gamma=1.0).camera


class Brightness:
    """A method that takes the difference of the images' means, in tenths of the full scale, for motion along x."""

    name = "brightness"

    def flow(self, image1: Image, image2: Image) -> np.ndarray:
        """See `gelflow.baselines.method.Method`."""
        flow = np.zeros((*image1.shape[:2], 2), dtype=np.float32)
        flow[..., 0] = 10 * (image2.mean() - image1.mean())
        return flow


def flat(value: float, channels: int = 3) -> Image:
    """An image of one value."""
    return np.full((60, 80, channels), value, dtype=np.float32)


@pytest.mark.parametrize("channels", [1, 3])
def test_changes_of_a_known_method(channels: int) -> None:
    """True motion 3 px; 4 px are measured on the clean pair and 4, 5, 3, 4 px on the four noisy pairs."""
    noisy = [[flat(v, channels) for v in state] for state in ((0.2, 0.1), (0.6, 0.5))]
    clean = [2 * [flat(v, channels)] for v in (0.2, 0.6)]
    truth = Truth(np.broadcast_to([3.0, 0.0], (60, 80, 2)).astype(np.float64), np.ones((60, 80), dtype=bool))
    found = changes(noisy, clean, CAMERA, truth, Brightness())
    for prefix in ("", "median_"):
        values = [found[f"{prefix}{name}_px"] for name in ("error", "change", "difference")]
        # 8 bits: 10 / 255 / 2 px of rounding in each image.
        assert values == pytest.approx([1.0, 0.0, 0.5], abs=0.04)
    assert changes(noisy, noisy, CAMERA, truth, Brightness())["difference_px"] == 0


def test_the_same_camera_noise_on_both_pairs() -> None:
    camera = CAMERA.model_copy(update={"read_noise": 0.2})
    pictures = [[flat(0.5)], [flat(0.5)]]
    truth = Truth(np.zeros((60, 80, 2)), np.ones((60, 80), dtype=bool))
    found = changes(pictures, pictures, camera, truth, Brightness())
    assert found["difference_px"] == found["change_px"] == 0
    assert found["error_px"] > 0
    assert np.isnan(found["change_se_px"])  # one pair has no spread


def test_jackknife_of_a_sum() -> None:
    """For values a_i + b_j it is exactly the standard error of the mean of a + b."""
    a, b = np.random.default_rng(0).standard_normal((2, 7))
    assert jackknife(a[:, None] + b[None, :]) == pytest.approx(np.std(a + b, ddof=1) / 7**0.5, rel=1e-12)


def test_an_image_is_not_compared_with_itself() -> None:
    means = others([[flat(0.1), flat(0.2), flat(0.6)]])[0]
    np.testing.assert_allclose([one[0, 0, 0] for one in means], [0.4, 0.35, 0.15], rtol=1e-6)
