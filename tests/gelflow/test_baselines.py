"""Classical methods on a motion that is known exactly."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from textures import moved

from gelflow.arrays import ImageArray
from gelflow.baselines import CLASSICAL, named_methods
from gelflow.baselines.aldic import ALDIC, INSTALL
from gelflow.baselines.registry import REGISTERED
from gelflow.baselines.scattered import dense_flow
from gelflow.config import REGISTRATIONS, Registration
from gelflow.errors import InputError
from gelflow.models.registration import registered

SHIFT = (0.7, -0.4)


# Median error in px: a matching error of a sixteenth of a px at the finest resolution that the method looks at. DIS
# ultrafast and fast stop at a quarter of the resolution (OpenCV: finest scale 2), DIS medium at a half; Farnebäck and
# TV-L1 end at full resolution, but TV-L1 is biased towards a flow without gradients: the same limit as DIS medium.
# Lucas-Kanade iterates at full resolution until steps are below 0.001 px; what is left is the rounding to 8 bit.
# Registration is to make of DIS medium's flow what Lucas-Kanade reaches.
TOLERANCE = {
    "lucas-kanade": 1 / 16,
    "farneback": 1 / 16,
    "dis-ultrafast": 4 / 16,
    "dis-fast": 4 / 16,
    "dis-medium": 2 / 16,
    "tvl1": 2 / 16,
    "dis-motion": 1 / 16,
    "dis-both": 1 / 16,
    "dis-brightness": 1 / 16,
}


@pytest.mark.parametrize("name", list(TOLERANCE))
def test_recovers_a_sub_pixel_shift(name: str) -> None:
    (method,) = named_methods([name])
    flow = method.flow(moved(72, 96, 0, 0), moved(72, 96, *SHIFT))
    assert flow.shape == (72, 96, 2)
    assert flow.dtype == np.float32
    error = np.hypot(flow[..., 0] - SHIFT[0], flow[..., 1] - SHIFT[1])[12:-12, 12:-12]
    assert np.median(error) < TOLERANCE[name]


def test_no_motion_is_zero() -> None:
    (method,) = named_methods(["none"])
    assert not method.flow(moved(20, 30, 0, 0), moved(20, 30, 1, 1)).any()


@pytest.mark.parametrize("name", [*CLASSICAL, *REGISTERED])
@pytest.mark.parametrize(
    ("image1", "image2", "word"),
    [
        (np.zeros((32, 32, 3), np.float32), np.zeros((32, 40, 3), np.float32), "shape"),
        (np.zeros((32, 32), np.float32), np.zeros((32, 32), np.float32), "shape"),
        (np.zeros((1, 1, 3), np.float32), np.zeros((1, 1, 3), np.float32), "16"),
        (np.full((32, 32, 3), np.nan, np.float32), np.zeros((32, 32, 3), np.float32), "NaN"),
    ],
)
def test_refuses_images_that_it_cannot_use(name: str, image1: ImageArray, image2: ImageArray, word: str) -> None:
    with pytest.raises(InputError, match=word):
        named_methods([name])[0].flow(image1, image2)


@pytest.mark.parametrize("names", [["raft"], ["none", "none"]])
def test_refuses_unknown_and_repeated_names(names: list[str]) -> None:
    with pytest.raises(InputError, match=names[0]):
        named_methods(names)


@pytest.mark.parametrize("name", [*CLASSICAL, *REGISTERED])
def test_works_on_the_smallest_allowed_images(name: str) -> None:
    image = moved(16, 16, 0, 0)
    assert named_methods([name])[0].flow(image, image).shape == (16, 16, 2)


@pytest.mark.parametrize("aim", ["motion", "both", "brightness"])
def test_a_registered_dis_is_dis_medium_registered(aim: Registration) -> None:
    """Fails with the images exchanged before the registration, and with the aims exchanged: a shade parts them."""
    shade = np.zeros((72, 96, 1), np.float32)
    shade[30:50, 40:60] = 0.2
    images = moved(72, 96, 0, 0), moved(72, 96, *SHIFT) + shade
    start, found = (method.flow(*images) for method in named_methods(["dis-medium", f"dis-{aim}"]))
    tensors = [torch.from_numpy(np.moveaxis(array, -1, 0).copy())[None] for array in (start, *images)]
    settings = REGISTRATIONS[aim]
    assert settings is not None
    np.testing.assert_array_equal(np.moveaxis(found, -1, 0), registered(*tensors, settings)[0].numpy())
    for other in {"motion", "both", "brightness"} - {aim}:
        assert np.abs(named_methods([f"dis-{other}"])[0].flow(*images) - found).max() > 0.01


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_registration_runs_where_it_is_asked_to() -> None:
    assert getattr(named_methods(["dis-motion"], "auto")[0], "device", None) == "cpu"
    with pytest.raises(InputError, match="no CUDA device"):
        named_methods(["dis-motion"], "cuda")


def test_interpolation_is_exact_for_affine_motion_inside_and_nearest_outside() -> None:
    """Fails with columns and rows of the points exchanged."""
    generator = np.random.default_rng(3)
    points = generator.uniform([5, 5], [35, 25], (60, 2))
    points[:4] = [(5, 5), (35, 5), (5, 25), (35, 25)]
    motion = points @ np.array([[0.1, -0.05], [0.02, 0.2]]) + (1.0, -2.0)
    flow = dense_flow(points, motion, 30, 40)
    columns, rows = np.meshgrid(np.arange(40.0), np.arange(30.0))
    true = np.stack([columns, rows], axis=-1) @ np.array([[0.1, -0.05], [0.02, 0.2]]) + (1.0, -2.0)
    # SciPy estimates the gradients iteratively, to 1e-6 of the values; float32 rounds 6e-7.
    np.testing.assert_allclose(flow[6:25, 6:35], true[6:25, 6:35], atol=2e-4)
    np.testing.assert_allclose(flow[0, 0], motion[0], rtol=1e-6)


def test_interpolation_of_few_points_is_the_nearest_one() -> None:
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
