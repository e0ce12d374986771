"""Classical methods on a motion that is known exactly."""

import itertools
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from textures import moved

from gelflow.baselines import CLASSICAL, named_methods
from gelflow.baselines.aldic import ALDIC, INSTALL
from gelflow.baselines.registry import REGISTERED
from gelflow.baselines.scattered import dense_flow
from gelflow.config import REGISTRATIONS, Registration
from gelflow.errors import InputError
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


def test_no_motion_is_zero_and_names_are_known_and_given_once() -> None:
    assert not named_methods(["none"])[0].flow(moved(20, 30, 0, 0), moved(20, 30, 1, 1)).any()
    for names in (["raft"], ["none", "none"]):
        with pytest.raises(InputError, match=names[0]):
            named_methods(names)


@pytest.mark.parametrize("name", [*CLASSICAL, *REGISTERED])
def test_images_from_16_px_on_serve_and_others_are_refused(name: str) -> None:
    (method,) = named_methods([name])
    image, good = moved(16, 16, 0, 0), np.zeros((32, 32, 3), np.float32)
    assert method.flow(image, image).shape == (16, 16, 2)
    for image1, image2, word in (
        (good, good[:, :20], "shape"), (good[..., 0], good[..., 0], "shape"), (good[:1, :1], good[:1, :1], "16"),
        (np.full_like(good, np.nan), good, "NaN"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=word):
            method.flow(image1, image2)


def test_a_registered_dis_is_dis_medium_registered() -> None:
    shade = np.zeros((72, 96, 1), np.float32)
    shade[30:50, 40:60] = 0.2  # parts the aims
    images = moved(72, 96, 0, 0), moved(72, 96, *SHIFT) + shade
    aims: tuple[Registration, ...] = ("motion", "both", "brightness")
    start, *found = (method.flow(*images) for method in named_methods(["dis-medium", *(f"dis-{aim}" for aim in aims)]))
    tensors = [torch.from_numpy(np.moveaxis(array, -1, 0).copy())[None] for array in (start, *images)]
    for aim, flow in zip(aims, found, strict=True):
        np.testing.assert_array_equal(np.moveaxis(flow, -1, 0), registered(*tensors, REGISTRATIONS[aim])[0].numpy())
    assert all(np.abs(one - other).max() > 0.01 for one, other in itertools.combinations(found, 2))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_registration_runs_where_it_is_asked_to() -> None:
    assert getattr(named_methods(["dis-motion"], "auto")[0], "device", None) == "cpu"
    with pytest.raises(InputError, match="no CUDA device"):
        named_methods(["dis-motion"], "cuda")


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


def test_lucas_kanade_says_that_nothing_can_be_tracked() -> None:
    grey = np.full((40, 40, 3), 0.5, np.float32)
    with pytest.raises(InputError, match="no corner"):
        named_methods(["lucas-kanade"])[0].flow(grey, grey)


@pytest.mark.skipif(find_spec("al_dic") is not None, reason="pyALDIC is installed")
def test_a_missing_package_is_named_with_how_to_get_it() -> None:
    image = moved(64, 64, 0, 0)
    with pytest.raises(InputError, match="pyALDIC cannot be imported") as error:
        named_methods(["al-dic"])[0].flow(image, image)
    assert INSTALL in str(error.value)


@pytest.mark.skipif(find_spec("al_dic") is None, reason="pyALDIC is not installed")
@pytest.mark.slow
def test_aldic_recovers_a_sub_pixel_shift() -> None:
    flow = ALDIC().flow(moved(96, 128, 0, 0), moved(96, 128, *SHIFT))
    # DIC reaches 0.01 to 0.02 px (Reu et al. 2022).
    assert np.median(np.hypot(flow[..., 0] - SHIFT[0], flow[..., 1] - SHIFT[1])) < 0.02
