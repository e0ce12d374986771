"""The weights "fast": DIS, fast registration and sigma, against exact flow, DIS and the network's registration."""

import numpy as np
import pytest
import torch
from commands import refused
from dots import PITCH, Turn, centres, grid, picture
from numpy.typing import NDArray
from waves import moved_pair, press_flow

import gelflow
from gelflow.baselines.classical import dis
from gelflow.fast import start
from gelflow.fast.certainty import refined
from gelflow.fast.registration import CONFIG, Prepared, register
from gelflow.models.registration import registered

HEIGHT, WIDTH = 240, 320


def pressed_dots(largest: float) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
    """Two images of dots, and the exact flow of a press between them."""
    flow = np.moveaxis(press_flow(HEIGHT, WIDTH, largest).numpy(), 0, -1)
    (x, y), dots = grid(HEIGHT, WIDTH), centres(HEIGHT, WIDTH)
    images = picture(x + flow[..., 0], y + flow[..., 1], dots), picture(x, y, dots)
    return *images, flow


def error(flow: NDArray, truth: NDArray) -> NDArray:
    """Where the flow does not come near the border."""
    return np.hypot(*np.moveaxis(flow - truth, -1, 0))[20:-20, 20:-20]


@pytest.mark.parametrize("largest", [2.0, 9.0])
def test_its_error_is_at_most_half_of_the_best_preset_of_dis_and_sigma_tells_it(largest: float) -> None:
    image1, image2, truth = pressed_dots(largest)
    found = gelflow.load_model("fast").estimate(image1, image2)
    best = min(error(dis(preset).flow(image1, image2), truth).mean() for preset in ("ultrafast", "fast", "medium"))
    off = error(found.flow, truth)
    assert off.mean() < best / 2
    # Sigma is the radius of 68 %; on images without noise it covers more, and far less would be overconfident.
    assert (off <= found.sigma[20:-20, 20:-20]).mean() > 0.5
    assert np.median(found.sigma) < 0.5
    assert found.visible[20:-20, 20:-20].min() > 0.9


@pytest.mark.parametrize("largest", [16.0, 26.0])
def test_dots_taken_for_the_next_ones_are_seen_and_the_network_finds_them(largest: float, monkeypatch) -> None:
    image1, image2, truth = pressed_dots(largest)
    model, asked = gelflow.load_model("fast"), []
    found, off = model.estimate(image1, image2), error(model.flow(image1, image2), truth)
    assert (off > PITCH / 2).mean() < 1e-3
    assert np.median(found.sigma) < 0.5
    monkeypatch.setattr(start, "shipped", lambda one, _: asked.append(1) or 0 * one[..., :2])
    found = model.estimate(image1, image2)
    wrong = np.hypot(*np.moveaxis(found.flow - truth, -1, 0)) > PITCH / 2
    assert asked
    assert wrong.mean() > 0.02
    # Of pixels that err by more than half a pitch, at most 5 % say sigma < 1 px.
    assert (found.sigma[wrong] < 1).mean() < 0.05
    assert (found.sigma < 1).mean() > 0.5


def test_no_network_is_asked_where_dots_move_little(monkeypatch) -> None:
    monkeypatch.setattr(start, "shipped", None)
    image1, image2, truth = pressed_dots(6.0)
    found = gelflow.load_model("fast").estimate(image1, image2)
    assert (found.sigma < 1).all()
    assert error(found.flow, truth).max() < PITCH / 2


def test_a_part_that_jumped_by_a_pitch_is_unknown_although_it_explains_the_images() -> None:
    """A regular grid at rest, and a flow that is off by a pitch in a disc."""
    places = np.arange(-PITCH, WIDTH + PITCH, PITCH)
    dots = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    x, y = grid(HEIGHT, WIDTH)
    first = Prepared(picture(x, y, dots))
    inside = np.hypot(x - 160, y - 120) < 50
    flow = np.where(inside[..., None], (PITCH, 0), 0).astype(np.float32)
    found = refined(register(flow, first, first), first, first)
    off = first.on_image(np.linalg.norm(found.flow, axis=-1)) > PITCH / 2
    assert off.mean() > 0.8 * inside.mean()
    assert (first.on_image(found.sigma) < 1)[off].mean() < 0.05
    # The cut is a ring of some 12 px, and three cells wider for gaps.
    assert first.on_image(found.known.astype(np.float32))[np.hypot(x - 160, y - 120) > 85].min() == 1


def test_it_registers_as_the_network_does_from_the_same_start() -> None:
    """A turn has no bend, so that windows of all widths are free of bias."""
    truth = torch.from_numpy(Turn(2.0, shift=(1.5, 0.5)).flow(120, 160)).movedim(-1, 0)
    image1, image2 = moved_pair(truth, seed=1)
    start = truth.float() + 0.3
    slow = registered(start[None], image1[None].float(), image2[None].float(), CONFIG)[0]
    first, second = (Prepared(np.moveaxis(image.float().numpy(), 0, -1)) for image in (image1, image2))
    quick = refined(register(np.moveaxis(start.numpy(), 0, -1).copy(), first, second), first, second).estimate(first)
    errors = [error(np.moveaxis(slow.numpy(), 0, -1), np.moveaxis(truth.numpy(), 0, -1)).mean()]
    errors.append(error(quick.flow, np.moveaxis(truth.numpy(), 0, -1)).mean())
    # The start is off by 0.42 px. Six steps under a prior of 0.2 px leave some thousandths of that; flow at every
    # second pixel and images read bilinearly, at half a px, are allowed as many again.
    assert max(errors) < 0.42 / 50


def test_nothing_is_known_of_unrelated_images() -> None:
    still = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.float64)
    images = [np.moveaxis(moved_pair(still, seed)[0].float().numpy(), 0, -1) for seed in (1, 2)]
    found = gelflow.load_model("fast").estimate(*images)
    related = gelflow.load_model("fast").estimate(images[0], images[0])
    assert (related.sigma < 1).all()
    # By chance, a part of the windows resemble each other.
    assert (found.sigma > 1).mean() > 0.8


@pytest.mark.parametrize("size", [(16, 16), (17, 23), (241, 323), (480, 640)])
def test_images_of_all_sizes_have_a_flow_in_their_own_px(size: tuple[int, int]) -> None:
    # Waves of 8 px and more stay visible in images of half the size, where 1/8 px is 1/16 px.
    image1, image2 = moved_pair(torch.tensor([1.5, -0.5]).view(2, 1, 1).expand(2, *size).double(), seed=2)
    flow = gelflow.load_model("fast").flow(*(np.moveaxis(i.float().numpy(), 0, -1) for i in (image1, image2)))
    assert flow.shape == (*size, 2)
    assert np.abs(np.median(flow, axis=(0, 1)) - (1.5, -0.5)).max() < 1 / 8


def test_tensors_batches_and_grey_images_give_the_flow_of_arrays() -> None:
    images = [Turn(shift=(shift, 0)).frame(64, 80, centres(64, 80)) for shift in (0.0, 1.5)]
    model = gelflow.load_model("fast")
    flow = model.flow(*images)
    np.testing.assert_array_equal(model.flow(*(np.stack([image] * 2) for image in images))[1], flow)
    tensors = [torch.from_numpy(image.astype(np.float32) / 255).movedim(-1, 0) for image in images]
    np.testing.assert_array_equal(model.flow(*tensors).movedim(0, -1).numpy(), flow)
    assert model.flow(*(image[..., 0] for image in images)).shape == flow.shape


def test_what_only_networks_have_is_refused() -> None:
    for given in ({"device": "cuda"}, {"size": (64, 64)}, {"registration": "motion"}):
        refused("fast: takes no size", gelflow.load_model, "fast", **given)
