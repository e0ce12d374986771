"""Metrics against closed forms and against scikit-image."""

import math

import numpy as np
import pytest
from skimage.metrics import structural_similarity
from textures import REAL, as_bytes, moved

from gelflow.baselines.classical import dis
from gelflow.compare.metrics import flow_errors, image_similarity, marker_distance, psnr, ssim, ssim_map, warp_image
from gelflow.compare.scores import score_pair
from gelflow.data import open_pairs
from gelflow.errors import InputError


def test_flow_errors_counts_only_pixels_that_see_gel_and_are_visible() -> None:
    truth, flow = np.zeros((2, 1, 6, 2), np.float32)
    flow[0, :, 0] = [0.0625, 0.5, 2.0, 4.0, 100.0, 100.0]  # exact in binary: no rounding in the expectations below
    truth[0, 4] = np.nan
    errors = flow_errors(flow, truth, np.array([[1, 1, 1, 1, 1, 0]], bool))
    assert (errors.pixels, errors.mean_px, errors.median_px) == (4, (0.0625 + 0.5 + 2 + 4) / 4, 1.25)
    assert (errors.outliers_1px, errors.outliers_01px) == (0.5, 0.75)
    flow[0, 0] = np.nan  # a missing estimate is an outlier
    errors = flow_errors(flow[:, :2], truth[:, :2], np.ones((1, 2), bool))
    assert errors.outliers_1px == 0.5
    assert math.isnan(errors.mean_px)
    for shape, visible in (((3, 4, 2), True), ((3, 5, 2), False)):
        with pytest.raises(InputError):
            flow_errors(np.zeros(shape, np.float32), np.zeros((3, 5, 2), np.float32), np.full((3, 5), visible))


def test_psnr_and_ssim_of_constant_images() -> None:
    image = np.full((20, 20, 3), 100, np.uint8)
    assert psnr(image, image + np.uint8(5)) == pytest.approx(10 * math.log10(255**2 / 25), abs=1e-12)
    assert psnr(image, image) == math.inf
    c1 = (0.01 * 255) ** 2
    # Variances vanish up to the rounding of blurred(x * x) - mean^2, about 1e-16 * 1e4, against c2 = 58.
    expected = (2 * 100 * 120 + c1) / (100**2 + 120**2 + c1)
    assert ssim(image[..., 0], image[..., 0] + np.uint8(20)) == pytest.approx(expected, abs=1e-9)
    still = np.zeros((32, 32, 2), np.float32)
    assert image_similarity(moved(32, 32, 0, 0), moved(32, 32, 0, 0), still) == (math.inf, 1.0)


def test_ssim_agrees_with_scikit_image_away_from_the_border() -> None:
    x, y = (as_bytes(moved(40, 50, *shift))[..., 1] for shift in ((0, 0), (0.7, 0.4)))
    options = {"data_range": 255, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    _, reference = structural_similarity(x, y, **options)
    inner = (slice(5, -5), slice(5, -5))  # half the window; the border is treated differently
    # Both are float64 with the same kernel: rounding of about 1e-16 * 255^2 / c2.
    np.testing.assert_allclose(ssim_map(x, y)[inner], reference[inner], atol=1e-9)


def test_warp_reproduces_a_linear_image_exactly_and_gives_nan_where_the_flow_is_nan() -> None:
    rows, columns = np.mgrid[:20, :30]
    image = np.repeat((0.01 * columns + 0.02 * rows)[..., None], 3, axis=2).astype(np.float32)
    flow = np.full((20, 30, 2), (1.3, -2.6), np.float32)
    # Bilinear interpolation is exact for linear functions; float32 rounds the image to 3e-8 and the flow to 1e-7.
    expected = image + 0.01 * 1.3 - 0.02 * 2.6
    np.testing.assert_allclose(warp_image(image, flow)[3:-3, 3:-3], expected[3:-3, 3:-3], atol=2e-7)
    flow[3, 4, 0] = np.nan
    np.testing.assert_array_equal(np.argwhere(np.isnan(warp_image(image, flow)).all(axis=2)), [[3, 4]])
    assert np.isnan(warp_image(image, flow)).sum() == 3


def test_warp_brings_image_2_to_image_1_and_not_the_other_way() -> None:
    image1, image2 = moved(48, 64, 0, 0), moved(48, 64, 2.3, -1.6)
    flow = np.full((48, 64, 2), (2.3, -1.6), np.float32)
    right, wrong = (np.abs(warp_image(image2, f) - image1)[4:-4, 4:-4] for f in (flow, -flow))
    # Bilinear error of a wave of amplitude a and length L is at most 2 * a/8 * (2 pi / L)^2; 24 waves of amplitude
    # <= 1/24 and L >= 8 px: 2/8 * (2 pi / 8)^2 = 0.154 if all were in phase. Random phases: a tenth of it.
    assert right.max() < 0.154
    assert right.mean() < 0.0154
    assert wrong.mean() > 3 * right.mean()


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
