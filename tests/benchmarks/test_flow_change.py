"""What render noise changes in a measured flow: a method whose answer is known, and the jackknife's standard error."""

import numpy as np
import pytest
from render_scenes import small_sensor

from benchmarks.flow_change import Truth, changes, jackknife
from benchmarks.render import others
from synth.arrays import Image

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
    counts = np.ones((60, 80), dtype=bool)
    truth = Truth(np.broadcast_to([3.0, 0.0], (60, 80, 2)).astype(np.float64), counts)
    found = changes(noisy, clean, CAMERA, truth, Brightness())
    # 8 bits: 10 / 255 / 2 px of rounding in each image.
    for prefix in ("", "median_"):
        assert found[f"{prefix}error_px"] == pytest.approx(1.0, abs=0.04)
        assert found[f"{prefix}change_px"] == pytest.approx(0.0, abs=0.04)
        assert found[f"{prefix}difference_px"] == pytest.approx(0.5, abs=0.04)
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
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 7))
    expected = np.std(a + b, ddof=1) / 7**0.5
    assert jackknife(a[:, None] + b[None, :]) == pytest.approx(expected, rel=1e-12)


def test_an_image_is_not_compared_with_itself() -> None:
    means = others([[flat(0.1), flat(0.2), flat(0.6)]])[0]
    np.testing.assert_allclose([one[0, 0, 0] for one in means], [0.4, 0.35, 0.15], rtol=1e-6)
