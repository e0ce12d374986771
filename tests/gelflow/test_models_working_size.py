"""The size at which large images are worked on, and what that makes of wide dots."""

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import gelflow
from gelflow.models.uncertainty import MAX_SIGMA_PX
from gelflow.models.working_size import working_size
from gelflow.ops.pyramid import resize_images


def dots(height: int, width: int, pitch: float, shift: float = 0.0) -> NDArray[np.uint8]:
    """Dark blurred dots on a grid that is not quite even, drawn at four times the size, and moved to the right."""
    rng, image = np.random.default_rng(0), np.full((4 * height, 4 * width, 3), 200, np.uint8)
    for x in np.arange(-pitch, width + pitch, pitch):
        for y in np.arange(-pitch, height + pitch, pitch):
            place = 4 * (np.array([x + shift, y]) + pitch * rng.uniform(-0.1, 0.1, 2))
            cv2.circle(image, (round(place[0]), round(place[1])), round(0.8 * pitch), (40, 45, 50), cv2.FILLED)
    image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(image, (0, 0), 0.07 * pitch).astype(np.uint8)


def size_of(image: NDArray[np.uint8]) -> tuple[int, int]:
    return working_size(torch.from_numpy(image).movedim(-1, 0)[None] / 255)


@pytest.mark.parametrize("scale", [2, 3, 8])
def test_however_large_the_image_wide_dots_are_seen_as_at_320_by_240(scale: int) -> None:
    assert size_of(dots(240 * scale, 320 * scale, 30.0 * scale)) == (240, 320)


def test_fine_patterns_and_small_images_keep_their_size_and_the_largest_are_reduced() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (960, 1280, 3), np.uint8)
    assert size_of(noise[:480, :640]) == (480, 640)
    assert size_of(noise) == (480, 640)
    assert size_of(dots(240, 320, 60.0)) == (240, 320)
    rows, columns = size_of(dots(480, 640, 25.0))
    assert 240 < rows < 420
    assert columns / rows == pytest.approx(640 / 480, rel=0.01)
    assert size_of(np.zeros((480, 640, 3), np.uint8)) == (480, 640)
    assert size_of(noise[:100].repeat(8, axis=1)) == (64, 6554)


def test_flow_and_sigma_of_an_enlarged_pair_are_those_of_the_pair_enlarged() -> None:
    images = [dots(720, 960, 90.0, shift).astype(np.float32) / 255 for shift in (0.0, 12.0)]
    tensors = [torch.from_numpy(image).movedim(-1, 0)[None] for image in images]
    reduced = [resize_images(tensor, (240, 320))[0].movedim(0, -1).clamp(0, 1).numpy() for tensor in tensors]
    model = gelflow.load_model("best", device="cpu")
    small, large = model.estimate(*reduced), model.estimate(*images)
    inside = slice(90, -90)
    assert np.abs(large.flow[inside, inside] - (12.0, 0.0)).max() < 0.5
    np.testing.assert_allclose(large.flow[1::3, 1::3], 3 * small.flow, rtol=0, atol=1e-3)
    np.testing.assert_allclose(large.sigma[1::3, 1::3], np.minimum(3 * small.sigma, MAX_SIGMA_PX), rtol=0.01)
    assert large.visible.mean() == pytest.approx(small.visible.mean(), abs=0.01)
    assert (large.flow.shape, large.sigma.dtype) == ((720, 960, 2), np.float32)
