"""Simpler methods of making flow against closed forms, and the statistics of render noise on made-up images."""

from dataclasses import replace

import numpy as np
import pytest
from render_scenes import flat_surface, plain, small_sensor

from benchmarks.flow import derived, method_row
from benchmarks.flow_change import Truth, changes, jackknife
from benchmarks.flow_methods import METHODS, SHIPPED, fitted_pinhole, is_inside
from benchmarks.image_error import camera_noise, errors, reference_noise
from benchmarks.pressed_gel import View, main_camera
from benchmarks.render import others
from benchmarks.rows import Row
from synth.arrays import Image
from synth.render import camera_image
from synth.render.camera_image import expected_signal

FOCAL = 160.0  # px, so that the gel's edges stay out of the image
LINEAR = small_sensor(gamma=1.0).camera
CAMERA = small_sensor(read_noise=0.0, shot_noise=0.0, gamma=1.0).camera


def moved(index: float, motion: tuple[float, float, float], cells: int = 12) -> View:
    """A flat gel that moves as a whole, mm; no refraction at index 1."""
    sensor = small_sensor(index, fx=FOCAL, fy=FOCAL)
    surface = flat_surface(sensor, cells)
    return View(sensor, plain(), surface, surface.material + np.array(motion))


def measured(view: View) -> dict[str, Row]:
    truth = derived(view)
    return {method: method_row(view, truth, method) for method in METHODS}


def test_every_method_is_right_where_it_leaves_out_nothing() -> None:
    """Without refraction, for motion along a flat face, flow is f t / Z everywhere and each simplification is exact."""
    view = moved(1.0, (0.47, -0.32, 0.0))  # its ends lie off the border
    expected = FOCAL * np.array([0.47, -0.32]) / 20.0
    # float64; the root search ends at 1e-6 of a triangle's weights at worst, here of 0.5 mm and 8 px/mm.
    np.testing.assert_allclose(derived(view)[0][0], np.broadcast_to(expected, (60, 80, 2)), atol=4e-6)
    for name, row in measured(view).items():
        assert row["max_px"] < 5e-6, name  # float32 flow of 4 px: 2.4e-7
        assert row["mask_px"] == 0, name


def test_what_a_camera_without_perspective_misses() -> None:
    """A gel that rises by 0.5 mm: no motion in x and y, so that the affine camera misses all of it."""
    view = moved(1.0, (0.0, 0.0, 0.5))
    truth = derived(view)
    row = method_row(view, truth, "affine camera, fitted")
    assert row["max_px"] == pytest.approx(max(np.linalg.norm(flow, axis=2).max() for flow, _ in truth), rel=1e-6)
    # f r / (Z - 0.5) - f r / Z at the corner pixel farthest from the axis, (42, 28) px; backward it is smaller.
    assert row["max_px"] == pytest.approx(np.hypot(42, 31) * (20 / 19.5 - 1), rel=0.03)


def test_the_fitted_pinhole_is_the_paraxial_one_and_refraction_left_out_a_scale() -> None:
    """Apparent depth: 14 mm of air and 6 mm of gel at n = 1.45 look like 14 + 6 / 1.45."""
    camera = fitted_pinhole(moved(1.45, (0, 0, 0))).camera
    # Off the axis the last term differs by (1 - 1 / n²) tan² / 2: 0.7 % of the depth at the corners.
    assert camera.fx / FOCAL == pytest.approx(20 / (14 + 6 / 1.45), rel=0.007)
    assert camera.fy / camera.fx == pytest.approx(1, rel=1e-12)
    # Seen straight from above a translation is scaled by the ratio of the apparent depths.
    found = measured(moved(1.45, (0.5, 0.0, 0.0)))
    lost = 0.5 * FOCAL * (1 / (14 + 6 / 1.45) - 1 / 20)
    # The depth differs by 0.25 % in the mean (as above), its derivative by up to three times that: 0.033 of 4.4 px.
    assert found["no refraction"]["mean_px"] == pytest.approx(lost, abs=0.033)
    assert found["no refraction, focal length fitted"]["mean_px"] < 0.1 * lost
    assert found["vertices of the rendered surface, interpolated"]["mean_px"] < 0.01 * lost


def test_occlusion() -> None:
    """A bump near the side of the image, so steep that it hides what lies behind it."""
    flat = moved(1.0, (0.0, 0.0, 0.0), 48)
    pressed = flat.pressed.copy()
    pressed[:, 2] += 2.5 * np.exp(-((pressed[:, 0] - 4.0) ** 2 + pressed[:, 1] ** 2) / 0.35**2)
    view = replace(flat, pressed=pressed)
    hidden = sum(int(np.count_nonzero(is_inside(flow) & ~visible)) for flow, visible in derived(view))
    found = measured(view)
    assert hidden > 5
    assert found[SHIPPED]["mask_px"] == found["every pixel tested for occlusion"]["mask_px"] == 0
    assert found["no test for occlusion"]["mask_px"] == hidden


def test_another_size_keeps_what_the_camera_sees() -> None:
    """The mean signal stays: the same field of view, exposure and vignetting."""
    sensor = small_sensor(1.45, vignetting=0.5)
    small = main_camera(sensor, 0.5)
    signals = [expected_signal(np.ones((c.height, c.width, 3), np.float32), c) for c in (sensor.camera, small.camera)]
    # The vignette is quadratic; its mean over pixels of twice the width differs by (1/80)² / 4 of 1/2 at most.
    assert signals[0].mean() == pytest.approx(signals[1].mean(), abs=1e-4)
    assert small.camera.fx / small.camera.width == sensor.camera.fx / sensor.camera.width


def images(count: int, deviation: float, offset: float = 0.0, seed: int = 0) -> list[Image]:
    noise = deviation * np.random.default_rng(seed).standard_normal((count, 60, 80, 3))
    return list((0.25 + offset + noise).astype(np.float32))


def test_errors_of_known_images() -> None:
    """Noise 0.01 in the images, 0.008 in each half of the reference, an offset of 0.004, full scale 255 levels."""
    reference = images(2, 0.008, seed=1)
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
    found = [errors(images(3, 0.01, seed=k), images(2, 0.01, seed=1000 + k), camera) for k in range(60)]
    # A standard deviation of 60 scores: within 1 ± 4 / sqrt(120).
    assert np.std([one["bias_percent"] / one["bias_se_percent"] for one in found]) == pytest.approx(1, abs=0.37)
    # Channels count as one though they are three: the limit is at 2 sqrt(3) standard errors, 0.03 % of the cases.
    assert sum(one["systematic"] > one["systematic_limit"] for one in found) <= 1


def test_camera_noise_is_the_models_and_the_same_on_both_pairs() -> None:
    """A grey of 0.25, where noise of 0.02 is far from both ends of the scale, and 16 bits."""
    camera = small_sensor(gamma=1.0, shot_noise=0.04, bit_depth=16).camera
    grey = np.full((60, 80, 3), 0.25, dtype=np.float32)
    # 14400 values: 0.6 %, 4 times.
    assert camera_noise(grey, camera) == pytest.approx(255 * camera_image.camera_noise(grey, camera), rel=0.024)
    camera = CAMERA.model_copy(update={"read_noise": 0.2})
    pictures = [[flat(0.5)], [flat(0.5)]]
    truth = Truth(np.zeros((60, 80, 2)), np.ones((60, 80), dtype=bool))
    found = changes(pictures, pictures, camera, truth, Brightness())
    assert found["difference_px"] == found["change_px"] == 0
    assert found["error_px"] > 0
    assert np.isnan(found["change_se_px"])  # one pair has no spread


class Brightness:
    """A method that takes the difference of the images' means, in tenths of the full scale, for motion along x."""

    name = "brightness"

    def flow(self, image1: Image, image2: Image) -> np.ndarray:
        flow = np.zeros((*image1.shape[:2], 2), dtype=np.float32)
        flow[..., 0] = 10 * (image2.mean() - image1.mean())
        return flow


def flat(value: float, channels: int = 3) -> Image:
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


def test_jackknife_of_a_sum_and_images_not_compared_with_themselves() -> None:
    """For values a_i + b_j it is exactly the standard error of the mean of a + b."""
    a, b = np.random.default_rng(0).standard_normal((2, 7))
    assert jackknife(a[:, None] + b[None, :]) == pytest.approx(np.std(a + b, ddof=1) / 7**0.5, rel=1e-12)
    means = others([[flat(0.1), flat(0.2), flat(0.6)]])[0]
    np.testing.assert_allclose([one[0, 0, 0] for one in means], [0.4, 0.35, 0.15], rtol=1e-6)
