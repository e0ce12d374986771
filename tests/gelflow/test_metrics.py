"""Metrics against closed forms and against scikit-image."""

import math

import numpy as np
import pytest
from textures import REAL, as_bytes, moved

from gelflow.baselines.classical import dis
from gelflow.compare.metrics import (
    endpoint_error,
    flow_errors,
    image_similarity,
    marker_distance,
    psnr,
    ssim,
    ssim_map,
    warp_image,
)
from gelflow.compare.scores import score_pair
from gelflow.data import open_pairs
from gelflow.errors import InputError


def test_endpoint_error_is_the_length_of_the_difference() -> None:
    truth = np.full((4, 5, 2), (1.0, -2.0), np.float32)
    assert np.array_equal(endpoint_error(truth + np.array([3, 4], np.float32), truth), np.full((4, 5), 5.0))


def test_flow_errors_counts_only_pixels_that_see_gel_and_are_visible() -> None:
    truth = np.zeros((1, 6, 2), np.float32)
    flow = np.zeros_like(truth)
    flow[0, :, 0] = [0.0625, 0.5, 2.0, 4.0, 100.0, 100.0]  # exact in binary: no rounding in the expectations below
    truth[0, 4] = np.nan
    visible = np.array([[1, 1, 1, 1, 1, 0]], bool)
    errors = flow_errors(flow, truth, visible)
    assert errors.pixels == 4
    assert errors.mean_px == (0.0625 + 0.5 + 2 + 4) / 4
    assert errors.median_px == 1.25
    assert errors.outliers_1px == 0.5
    assert errors.outliers_01px == 0.75


def test_flow_errors_calls_a_missing_estimate_an_outlier() -> None:
    flow = np.zeros((1, 2, 2), np.float32)
    flow[0, 0] = np.nan
    errors = flow_errors(flow, np.zeros_like(flow), np.ones((1, 2), bool))
    assert errors.outliers_1px == 0.5
    assert math.isnan(errors.mean_px)


@pytest.mark.parametrize(("shape", "visible"), [((3, 4, 2), True), ((3, 5, 2), False)])
def test_flow_errors_refuses_other_shapes_and_nothing_to_compare(shape: tuple[int, ...], visible: bool) -> None:
    with pytest.raises(InputError):
        flow_errors(np.zeros(shape, np.float32), np.zeros((3, 5, 2), np.float32), np.full((3, 5), visible))


def test_psnr_of_a_constant_difference() -> None:
    image = np.full((8, 9, 3), 100, np.uint8)
    assert psnr(image, image + np.uint8(5)) == pytest.approx(10 * math.log10(255**2 / 25), abs=1e-12)
    assert psnr(image, image) == math.inf


def test_ssim_of_constant_images() -> None:
    a, b, c1 = 100.0, 120.0, (0.01 * 255) ** 2
    value = ssim(np.full((20, 20), 100, np.uint8), np.full((20, 20), 120, np.uint8))
    # Variances vanish up to the rounding of blurred(x * x) - mean^2, about 1e-16 * 1e4, against c2 = 58.
    assert value == pytest.approx((2 * a * b + c1) / (a * a + b * b + c1), abs=1e-9)


def test_ssim_agrees_with_scikit_image_away_from_the_border() -> None:
    from skimage.metrics import structural_similarity

    x = as_bytes(moved(40, 50, 0, 0))[..., 1]
    y = as_bytes(moved(40, 50, 0.7, 0.4))[..., 1]
    _, reference = structural_similarity(
        x, y, data_range=255, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )
    inner = (slice(5, -5), slice(5, -5))  # half the window; the border is treated differently
    # Both are float64 with the same kernel: rounding of about 1e-16 * 255^2 / c2.
    np.testing.assert_allclose(ssim_map(x, y)[inner], reference[inner], atol=1e-9)


def test_warp_reproduces_a_linear_image_exactly() -> None:
    rows, columns = np.mgrid[:20, :30]
    image = np.repeat((0.01 * columns + 0.02 * rows)[..., None], 3, axis=2).astype(np.float32)
    flow = np.full((20, 30, 2), (1.3, -2.6), np.float32)
    warped = warp_image(image, flow)[3:-3, 3:-3]
    # Bilinear interpolation is exact for linear functions; float32 rounds the image to 3e-8 and the flow to 1e-7.
    np.testing.assert_allclose(warped, image[3:-3, 3:-3] + 0.01 * 1.3 - 0.02 * 2.6, atol=2e-7)


def test_warp_brings_image_2_to_image_1_and_not_the_other_way() -> None:
    u, v = 2.3, -1.6
    image1, image2 = moved(48, 64, 0, 0), moved(48, 64, u, v)
    flow = np.full((48, 64, 2), (u, v), np.float32)
    inner = (slice(4, -4), slice(4, -4))
    right = np.abs(warp_image(image2, flow) - image1)[inner]
    wrong = np.abs(warp_image(image2, -flow) - image1)[inner]
    # Bilinear error of a wave of amplitude a and length L is at most 2 * a/8 * (2 pi / L)^2; 24 waves of amplitude
    # <= 1/24 and L >= 8 px: 2/8 * (2 pi / 8)^2 = 0.154 if all were in phase. Random phases: a tenth of it.
    assert right.max() < 0.154
    assert right.mean() < 0.0154
    assert wrong.mean() > 3 * right.mean()


def test_warp_gives_nan_where_the_flow_is_nan() -> None:
    flow = np.zeros((20, 20, 2), np.float32)
    flow[3, 4, 0] = np.nan
    warped = warp_image(moved(20, 20, 0, 0), flow)
    assert np.isnan(warped[3, 4]).all()
    assert np.isnan(warped).sum() == 3


def test_no_motion_between_equal_images_is_perfect() -> None:
    image = moved(32, 32, 0, 0)
    assert image_similarity(image, image, np.zeros((32, 32, 2), np.float32)) == (math.inf, 1.0)


def test_marker_distance_of_a_constant_flow() -> None:
    flow = np.full((30, 40, 2), (2.0, -1.0), np.float32)
    markers = np.array([[5.5, 6.5, 7.5, 5.5], [10, 10, 15, 13], [20, 20, 22, 19.5]])  # off by 0, (3, 4) and 0.5
    assert marker_distance(flow, markers) == pytest.approx(0.5, abs=1e-6)


@pytest.mark.skipif(not (REAL / "validation").is_dir(), reason="the real recordings are not beside the repository")
def test_real_pair_has_the_published_numbers() -> None:
    """PSNR, SSIM and distance to dots that another script measured: 32.30 dB, .961 and .14 px, to their last digit."""
    dataset = open_pairs(REAL / "validation")
    score = score_pair(dis("medium"), dataset, dataset.names.index("gsmini_rubic_val"))
    assert score.psnr_db == pytest.approx(32.30, abs=0.01)
    assert score.ssim == pytest.approx(0.961, abs=0.001)
    assert score.marker_distance_px == pytest.approx(0.14, abs=0.01)
