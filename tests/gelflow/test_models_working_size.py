"""The sizes at which large images are worked on, and what that makes of wide dots."""

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import gelflow
from gelflow.arrays import Flow, Images
from gelflow.models.estimate import estimate_flow
from gelflow.models.uncertainty import UNKNOWN_PX
from gelflow.models.weights import load_weights, weights_file
from gelflow.models.working_size import unknown_px, working_sizes
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


@pytest.mark.parametrize(("given", "sizes"), [
    ((240, 320), [(240, 320)]),
    ((300, 400), [(300, 400)]),
    ((480, 640), [(480, 640), (240, 320)]),
    ((480, 480), [(480, 480), (277, 277)]),
    ((2448, 3264), [(480, 640), (240, 320)]),
    ((100, 2000), [(100, 2000)]),
    ((64, 20000), [(64, 20000)]),
])  # fmt: skip
def test_large_images_are_worked_on_at_two_sizes(given: tuple[int, int], sizes: list[tuple[int, int]]) -> None:
    assert working_sizes(*given) == sizes


def test_a_fine_pattern_keeps_its_size_and_each_pair_of_a_batch_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of noise whose detail is lost at half the size, and of wide dots."""
    noise = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    pairs = [(cv2.GaussianBlur(noise, (0, 0), 1.0), 2), (dots(480, 640, 60.0), 3)]
    first = torch.stack([torch.from_numpy(image).movedim(-1, 0) / 255 for image, _ in pairs])
    second = torch.stack([torch.from_numpy(np.roll(image, by, axis=1)).movedim(-1, 0) / 255 for image, by in pairs])
    network = load_weights(weights_file(None))
    sizes: list[tuple[int, int]] = []

    def flow(image1: Images, image2: Images) -> Flow:
        sizes.append((image1.shape[-2], image1.shape[-1]))
        shift = torch.tensor([2.0, 3.0]).view(2, 1, 1, 1) * image1.shape[-1] / 640
        wrong = 0.5 * (torch.tensor([1, 0]) if len(sizes) == 2 else torch.tensor([0, 1])).view(2, 1, 1, 1)
        return torch.cat([shift + wrong, 0 * shift], dim=1).expand(2, 2, *image1.shape[-2:])

    monkeypatch.setattr(network, "flow", flow)
    found = estimate_flow(network, first, second)
    assert sizes == [(480, 640), (240, 320)]
    np.testing.assert_allclose(found[:, 0, 240, 320], [2.0, 3.0], atol=1e-3)


def test_where_the_two_flows_differ_much_the_one_that_closes_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """A jump by 20 px in both directions, on images that do not tell."""
    still = torch.zeros(1, 3, 480, 640)

    def flow(image1: Images, image2: Images) -> Flow:
        return torch.full((1, 2, *image1.shape[-2:]), 20.0 if image1.shape[-1] == 640 else 0.0)

    network = load_weights(weights_file(None))
    monkeypatch.setattr(network, "flow", flow)
    assert not estimate_flow(network, still, still).any()


def test_flow_and_sigma_of_an_enlarged_pair_are_those_of_the_pair_enlarged() -> None:
    images = [dots(720, 960, 90.0, shift).astype(np.float32) / 255 for shift in (0.0, 12.0)]
    tensors = [torch.from_numpy(image).movedim(-1, 0)[None] for image in images]
    reduced = [resize_images(tensor, (240, 320))[0].movedim(0, -1).clamp(0, 1).numpy() for tensor in tensors]
    model = gelflow.load_model("best", device="cpu")
    small, large = model.estimate(*reduced), model.estimate(*images)
    inside = slice(90, -90)
    assert np.abs(large.flow[inside, inside] - (12.0, 0.0)).max() < 0.5
    np.testing.assert_allclose(large.flow[1::3, 1::3], 3 * small.flow, rtol=0, atol=1e-3)
    assert unknown_px(720, 960) == pytest.approx(2.4 * UNKNOWN_PX)
    assert (large.sigma < UNKNOWN_PX).mean() > 0.95
    assert large.visible.mean() == pytest.approx(small.visible.mean(), abs=0.01)
    assert (large.flow.shape, large.sigma.dtype) == ((720, 960, 2), np.float32)
