"""Classical methods on a motion that is known exactly; metrics against closed forms and against scikit-image."""

import itertools
import math
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from commands import refused
from skimage.metrics import structural_similarity
from textures import REAL, as_bytes, moved

from gelflow.baselines import CLASSICAL, named_methods
from gelflow.baselines.aldic import ALDIC, INSTALL
from gelflow.baselines.classical import dis
from gelflow.baselines.registry import REGISTERED
from gelflow.baselines.scattered import dense_flow
from gelflow.compare.metrics import flow_errors, image_similarity, marker_distance, psnr, ssim_map, warp_image
from gelflow.compare.scores import score_pair
from gelflow.config import REGISTRATIONS, Registration
from gelflow.data import PairDataset
from gelflow.methods.method import as_tensor
from gelflow.models.registration import registered

SHIFT = (0.7, -0.4)
# Median error in px: a sixteenth of a px at the finest resolution that the method looks at. DIS ultrafast and fast stop
# at a quarter of the resolution, DIS medium at a half; TV-L1 is biased towards a flow without gradients.
TOLERANCE = {
    **dict.fromkeys(["lucas-kanade", "farneback", "dis-motion", "dis-both", "dis-brightness"], 1 / 16),
    **dict.fromkeys(["dis-medium", "tvl1"], 2 / 16),
    **dict.fromkeys(["dis-ultrafast", "dis-fast"], 4 / 16),
}


@pytest.mark.parametrize("name", list(TOLERANCE))
def test_recovers_a_sub_pixel_shift(name: str) -> None:
    (method,) = named_methods([name])
    flow = method.flow(moved(72, 96, 0, 0), moved(72, 96, *SHIFT))
    assert (flow.shape, flow.dtype) == ((72, 96, 2), np.float32)
    assert np.median(np.hypot(*np.moveaxis(flow - np.float32(SHIFT), -1, 0))[12:-12, 12:-12]) < TOLERANCE[name]


def test_no_motion_is_zero_and_what_cannot_serve_is_named() -> None:
    assert not named_methods(["none"])[0].flow(moved(20, 30, 0, 0), moved(20, 30, 1, 1)).any()
    for names in (["raft"], ["none", "none"]):
        refused(names[0], named_methods, names)
    grey = np.full((40, 40, 3), 0.5, np.float32)
    refused("no corner", named_methods(["lucas-kanade"])[0].flow, grey, grey)


@pytest.mark.parametrize("name", [*CLASSICAL, *REGISTERED])
def test_images_from_16_px_on_serve_and_others_are_refused(name: str) -> None:
    (method,) = named_methods([name])
    image, good = moved(16, 16, 0, 0), np.zeros((32, 32, 3), np.float32)
    assert method.flow(image, image).shape == (16, 16, 2)
    for image1, image2, word in (
        (good, good[:, :20], "shape"), (good[..., 0], good[..., 0], "shape"), (good[:1, :1], good[:1, :1], "16"),
        (np.full_like(good, np.nan), good, "NaN"),
    ):  # fmt: skip
        refused(word, method.flow, image1, image2)


def test_a_registered_dis_is_dis_medium_registered() -> None:
    shade = np.zeros((72, 96, 1), np.float32)
    shade[30:50, 40:60] = 0.2  # parts the aims
    images = moved(72, 96, 0, 0), moved(72, 96, *SHIFT) + shade
    aims: tuple[Registration, ...] = ("motion", "both", "brightness")
    start, *found = (method.flow(*images) for method in named_methods(["dis-medium", *(f"dis-{aim}" for aim in aims)]))
    tensors = [as_tensor(array, "cpu") for array in (start, *images)]
    for aim, flow in zip(aims, found, strict=True):
        np.testing.assert_array_equal(np.moveaxis(flow, -1, 0), registered(*tensors, REGISTRATIONS[aim])[0].numpy())
    assert all(np.abs(one - other).max() > 0.01 for one, other in itertools.combinations(found, 2))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_registration_runs_where_it_is_asked_to() -> None:
    assert getattr(named_methods(["dis-motion"], "auto")[0], "device", None) == "cpu"
    refused("no CUDA device", named_methods, ["dis-motion"], "cuda")


def test_interpolation_is_exact_for_affine_motion_inside_and_nearest_outside() -> None:
    points = np.random.default_rng(3).uniform([5, 5], [35, 25], (60, 2))
    points[:4] = [(5, 5), (35, 5), (5, 25), (35, 25)]

    def motion(places: np.ndarray) -> np.ndarray:
        return places @ np.array([[0.1, -0.05], [0.02, 0.2]]) + (1.0, -2.0)

    flow = dense_flow(points, motion(points), 30, 40)
    true = motion(np.stack(np.meshgrid(np.arange(40.0), np.arange(30.0)), axis=-1))
    # SciPy estimates the gradients iteratively, to 1e-6 of the values; float32 rounds 6e-7.
    np.testing.assert_allclose(flow[6:25, 6:35], true[6:25, 6:35], atol=2e-4)
    np.testing.assert_allclose(flow[0, 0], motion(points)[0], rtol=1e-6)
    assert (dense_flow(np.array([[3.0, 4.0]]), np.array([[1.0, 2.0]]), 8, 9) == (1.0, 2.0)).all()
    line = np.stack([np.arange(6.0), np.arange(6.0)], axis=1)
    assert dense_flow(line, line, 8, 9)[5, 5, 0] == 5.0


@pytest.mark.skipif(find_spec("al_dic") is not None, reason="pyALDIC is installed")
def test_a_missing_package_is_named_with_how_to_get_it() -> None:
    image = moved(64, 64, 0, 0)
    assert INSTALL in refused("pyALDIC cannot be imported", named_methods(["al-dic"])[0].flow, image, image)


@pytest.mark.skipif(find_spec("al_dic") is None, reason="pyALDIC is not installed")
@pytest.mark.slow
def test_aldic_recovers_a_sub_pixel_shift() -> None:
    flow = ALDIC().flow(moved(96, 128, 0, 0), moved(96, 128, *SHIFT))
    # DIC reaches 0.01 to 0.02 px (Reu et al. 2022).
    assert np.median(np.hypot(flow[..., 0] - SHIFT[0], flow[..., 1] - SHIFT[1])) < 0.02


def test_flow_errors_count_visible_gel_only_and_marker_distance_of_a_constant_flow() -> None:
    truth, flow = np.zeros((2, 1, 6, 2), np.float32)
    flow[0, :, 0] = [0.0625, 0.5, 2.0, 4.0, 100.0, 100.0]  # exact in binary: no rounding in the expectations below
    truth[0, 4] = np.nan
    errors = flow_errors(flow, truth, np.array([[1, 1, 1, 1, 1, 0]], bool))
    assert list(errors.values()) == [(0.0625 + 0.5 + 2 + 4) / 4, 1.25, 0.5, 0.75]
    flow[0, 0] = np.nan  # a missing estimate is an outlier
    errors = flow_errors(flow[:, :2], truth[:, :2], np.ones((1, 2), bool))
    assert errors["outliers_1px"] == 0.5
    assert math.isnan(errors["endpoint_error_px"])
    for shape, visible in (((3, 4, 2), True), ((3, 5, 2), False)):
        truth = np.zeros((3, 5, 2), np.float32)
        refused(".", flow_errors, np.zeros(shape, np.float32), truth, np.full((3, 5), visible))
    flow = np.full((30, 40, 2), (2.0, -1.0), np.float32)
    markers = np.array([[5.5, 6.5, 7.5, 5.5], [10, 10, 15, 13], [20, 20, 22, 19.5]])  # off by 0, (3, 4) and 0.5
    assert marker_distance(flow, markers) == pytest.approx(0.5, abs=1e-6)


def test_psnr_and_ssim_of_constant_images_and_as_scikit_image_has_it() -> None:
    image = np.full((20, 20, 3), 100, np.uint8)
    assert psnr(image, image + np.uint8(5)) == pytest.approx(10 * math.log10(255**2 / 25), abs=1e-12)
    assert psnr(image, image) == math.inf
    c1 = (0.01 * 255) ** 2
    # Variances vanish up to the rounding of blurred(x * x) - mean^2, about 1e-16 * 1e4, against c2 = 58.
    expected = (2 * 100 * 120 + c1) / (100**2 + 120**2 + c1)
    assert ssim_map(image[..., 0], image[..., 0] + np.uint8(20)).mean() == pytest.approx(expected, abs=1e-9)
    still = np.zeros((32, 32, 2), np.float32)
    assert image_similarity(moved(32, 32, 0, 0), moved(32, 32, 0, 0), still) == (math.inf, 1.0)
    x, y = (as_bytes(moved(40, 50, *shift))[..., 1] for shift in ((0, 0), (0.7, 0.4)))
    options = {"data_range": 255, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
    _, reference = structural_similarity(x, y, **options)
    inner = (slice(5, -5), slice(5, -5))  # half the window; the border is treated differently
    # Both are float64 with the same kernel: rounding of about 1e-16 * 255^2 / c2.
    np.testing.assert_allclose(ssim_map(x, y)[inner], reference[inner], atol=1e-9)


def test_warp_brings_image_2_to_image_1_exactly_where_linear_and_nan_where_unknown() -> None:
    rows, columns = np.mgrid[:20, :30]
    image = np.repeat((0.01 * columns + 0.02 * rows)[..., None], 3, axis=2).astype(np.float32)
    flow = np.full((20, 30, 2), (1.3, -2.6), np.float32)
    # Bilinear interpolation is exact for linear functions; float32 rounds the image to 3e-8 and the flow to 1e-7.
    expected = image + 0.01 * 1.3 - 0.02 * 2.6
    np.testing.assert_allclose(warp_image(image, flow)[3:-3, 3:-3], expected[3:-3, 3:-3], atol=2e-7)
    flow[3, 4, 0] = np.nan
    np.testing.assert_array_equal(np.argwhere(np.isnan(warp_image(image, flow)).all(axis=2)), [[3, 4]])
    assert np.isnan(warp_image(image, flow)).sum() == 3
    image1, image2 = moved(48, 64, 0, 0), moved(48, 64, 2.3, -1.6)
    flow = np.full((48, 64, 2), (2.3, -1.6), np.float32)
    right, wrong = (np.abs(warp_image(image2, f) - image1)[4:-4, 4:-4] for f in (flow, -flow))
    # Bilinear error of a wave of amplitude a and length L is at most 2 * a/8 * (2 pi / L)^2; 24 waves of amplitude
    # <= 1/24 and L >= 8 px: 2/8 * (2 pi / 8)^2 = 0.154 if all were in phase. Random phases: a tenth of it.
    assert right.max() < 0.154
    assert right.mean() < 0.0154
    assert wrong.mean() > 3 * right.mean()


@pytest.mark.skipif(not (REAL / "validation").is_dir(), reason="the real recordings are not beside the repository")
def test_real_pair_has_the_published_numbers() -> None:
    """PSNR, SSIM and distance to dots that another script measured: 32.30 dB, .961 and .14 px, to their last digit."""
    dataset = PairDataset(REAL / "validation")
    score = score_pair(dis("medium"), dataset, dataset.names.index("gsmini_rubic_val"))
    assert score.psnr_db == pytest.approx(32.30, abs=0.01)
    assert score.ssim == pytest.approx(0.961, abs=0.001)
    assert score.marker_distance_px == pytest.approx(0.14, abs=0.01)
