"""Classical methods on a motion that is known exactly."""

import numpy as np
import pytest
from textures import moved

from gelflow.baselines import CLASSICAL, named_methods
from gelflow.errors import InputError
from gelflow.raster import ImageArray

SHIFT = (0.7, -0.4)


# Median error in px: a matching error of a sixteenth of a px at the finest resolution that the method looks at. DIS
# ultrafast and fast stop at a quarter of the resolution (OpenCV: finest scale 2), DIS medium at a half; Farnebäck and
# TV-L1 end at full resolution, but TV-L1 is biased towards a flow without gradients: the same limit as DIS medium.
TOLERANCE = {"farneback": 1 / 16, "dis-ultrafast": 4 / 16, "dis-fast": 4 / 16, "dis-medium": 2 / 16, "tvl1": 2 / 16}


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


@pytest.mark.parametrize("name", list(CLASSICAL))
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


@pytest.mark.parametrize("name", list(CLASSICAL))
def test_works_on_the_smallest_allowed_images(name: str) -> None:
    image = moved(16, 16, 0, 0)
    assert named_methods([name])[0].flow(image, image).shape == (16, 16, 2)
