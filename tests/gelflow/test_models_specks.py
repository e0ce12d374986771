"""Specks in the optics: sigma is raised where they draw the flow to zero, and nowhere else."""

import sys

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from textures import grid, texture

import gelflow
from gelflow.arrays import Estimate
from gelflow.config import LossConfig, ModelConfig, RegistrationConfig, TrainConfig
from gelflow.fast import certainty
from gelflow.fast.specks import speck_error as fast_speck_error
from gelflow.models import GelFlow
from gelflow.models.registration import registered
from gelflow.models.specks import speck_error, surroundings, without_specks
from gelflow.models.uncertainty import flow_sigma
from gelflow.training.module import FlowModule

HEIGHT, WIDTH, REACH_PX = 144, 192, 8.0
PLACES = ((40, 45), (70, 100), (150, 40), (120, 100), (165, 115))
"""Columns and rows of the specks' centres, between and upon the dots."""
Array = NDArray[np.float64]


def motion(kind: str) -> tuple[Array, Array]:
    """Where the gel at each pixel of image 2 was in image 1, px to the left and up."""
    x, y = grid(HEIGHT, WIDTH)
    if kind == "turn":
        return 0.06 * (y - 150) + 3, -0.06 * (x - 96)
    shift = {"shift": 1.0, "slow": 0.5, "creep": 0.1}.get(kind, 0.0)
    square = (x - 90) ** 2 + (y - 70) ** 2
    height = np.exp(-square / (2 * 45**2)) if kind == "press" else shift + 0 * x
    if kind == "around":
        height = 1 - np.exp(-square / (2 * 16**2))
    return 3.0 * height, -2.0 * height


def gel(kind: str, x: Array, y: Array) -> Array:
    if kind == "waves":
        return texture(x, y).astype(float)
    radius = np.hypot(x % 24 - 12, y % 24 - 12)
    return (0.5 - 0.35 / (1 + np.exp((radius - 4) / 0.6)))[..., None] * np.ones(3)


def opacity(kind: str, x: Array, y: Array) -> Array:
    """Of blurred specks: white discs, dark grains, rims of bubbles, and scratches; 0 to 1."""
    total = np.zeros_like(x)
    for column, row in PLACES if kind != "none" else ():
        right, down = x - column, y - row
        edge = np.hypot(right, down) - 3.5
        if kind == "bubble":
            edge = np.abs(edge) - 1.0
        elif kind == "scratch":
            edge = np.maximum(np.abs(right + down) / np.sqrt(2) - 1.2, np.hypot(right, down) - 12)
        total = np.maximum(total, 0.9 / (1 + np.exp(edge / 0.7)))
    return total


def pair(kind: str, moves: str, specks: str) -> tuple[Array, Array, Array, Array]:
    """Both images, the true flow (H, W, 2) to first order, and where specks are."""
    x, y = grid(HEIGHT, WIDTH)
    u, v = motion(moves)
    cover, noise = opacity(specks, x, y), np.random.default_rng(0)
    colour = 0.1 if specks == "dust" else 0.95
    seen = [each + cover[..., None] * (colour - each) for each in (gel(kind, x, y), gel(kind, x - u, y - v))]
    noisy = [np.clip(each + 0.005 * noise.standard_normal(each.shape), 0, 1) for each in seen]
    # V(x) = d(x + V(x)) of a displacement d that is smooth: three steps of the iteration leave less than .02 px here.
    flow = np.stack([u, v], axis=-1)
    start = flow
    for _ in range(3):
        flow = start + np.einsum("hwcd,hwd->hwc", np.stack(np.gradient(start, axis=(1, 0)), axis=-1), flow)
    return (*noisy, flow, cover > 0.3)


def distance_to(mask: Array) -> Array:
    x, y = grid(HEIGHT, WIDTH)
    rows, columns = np.nonzero(mask)
    return np.min(
        [np.hypot(x - column - 0.5, y - row - 0.5) for row, column in zip(rows, columns, strict=True)], axis=0
    )


def tensor(image: Array) -> torch.Tensor:
    return torch.from_numpy(np.moveaxis(image, -1, 0)[None]).float()


def wrong_share(flow: Array, truth: Array, sigma: Array, near: Array) -> float:
    """The share of a place's pixels that err by more than 1 px with a sigma below .5."""
    return float(((np.linalg.norm(flow - truth, axis=-1) > 1) & (sigma < 0.5))[near].mean())


@pytest.mark.parametrize("kind", ["dots", "waves"])
@pytest.mark.parametrize("moves", ["shift", "press", "turn"])
@pytest.mark.parametrize("specks", ["disc", "dust", "bubble", "scratch"])
def test_where_specks_draw_the_flow_to_zero_it_is_uncertain(kind: str, moves: str, specks: str) -> None:
    image1, image2, truth, mask = pair(kind, moves, specks)
    distance = distance_to(mask)
    drawn = truth * (1 - np.exp(-(np.maximum(distance - 1, 0) ** 2) / (2 * 4**2)))[..., None]
    images = tensor(image1), tensor(image2)
    sigma = flow_sigma(tensor(drawn), *images)[0][0, 0].numpy()
    assert wrong_share(drawn, truth, sigma, distance <= REACH_PX) <= 0.05
    # 6 px by the window, three cells of 6 px along the diagonal, and one more by interpolation: 38 px.
    added = speck_error(tensor(drawn), *images, torch.ones(1, 1, HEIGHT, WIDTH))[0, 0].numpy()
    assert added[distance > 38].max(initial=0) == 0


@pytest.mark.parametrize("kind", ["dots", "waves"])
@pytest.mark.parametrize(
    ("moves", "specks"), [("none", "disc"), ("shift", "none"), ("press", "none"), ("turn", "none")]
)
def test_without_motion_or_without_specks_nothing_is_added(kind: str, moves: str, specks: str) -> None:
    image1, image2, truth, _ = pair(kind, moves, specks)
    assert speck_error(tensor(truth), tensor(image1), tensor(image2), torch.ones(1, 1, HEIGHT, WIDTH)).max() == 0


def fast_with_specks(image1: Array, image2: Array, monkeypatch: pytest.MonkeyPatch) -> tuple[Estimate, Array]:
    """The estimate of "fast", and the error that it adds near specks, (H, W) px^2."""
    added = []
    monkeypatch.setattr(certainty, "speck_error", lambda *of: added.append(fast_speck_error(*of)) or added[-1])
    found = gelflow.load_model("fast").estimate(image1.astype(np.float32), image2.astype(np.float32))
    return found, added[0].repeat(4, axis=0).repeat(4, axis=1)


@pytest.mark.parametrize("kind", ["dots", "waves"])
@pytest.mark.parametrize("moves", ["shift", "press"])
@pytest.mark.parametrize("specks", ["disc", "dust", "bubble"])
def test_where_specks_draw_fast_its_sigma_says_so(kind: str, moves: str, specks: str, monkeypatch) -> None:
    image1, image2, truth, mask = pair(kind, moves, specks)
    found, added = fast_with_specks(image1, image2, monkeypatch)
    distance = distance_to(mask)
    wrong = (np.linalg.norm(found.flow - truth, axis=-1) > 1) & (distance <= REACH_PX)
    assert wrong.sum() > 100, "the specks do nothing"
    assert (found.sigma[wrong] < 0.5).mean() <= 0.05
    # A cell of 4 px sees 6 px around its centre, and raises two cells around it, 10 px: 16 px along each axis.
    assert added[distance > 16 * np.sqrt(2) + 1].max() == 0


@pytest.mark.parametrize("kind", ["dots", "waves"])
@pytest.mark.parametrize(
    ("moves", "specks"),
    [("none", "disc"), ("shift", "none"), ("press", "none"), ("turn", "none"), ("around", "none")],
)
def test_without_motion_or_without_specks_fast_adds_nothing(kind: str, moves: str, specks: str, monkeypatch) -> None:
    image1, image2, _, _ = pair(kind, moves, specks)
    assert fast_with_specks(image1, image2, monkeypatch)[1].max() == 0


def near_error(found: torch.Tensor, truth: Array, mask: Array) -> float:
    error = np.linalg.norm(np.moveaxis(found[0].numpy(), 0, -1) - truth, axis=-1)
    return float(error[distance_to(mask) <= REACH_PX].mean())


@pytest.mark.parametrize("kind", ["dots", "waves"])
@pytest.mark.parametrize("moves", ["shift", "slow"])
@pytest.mark.parametrize("specks", ["disc", "dust", "bubble", "scratch"])
def test_registration_keeps_a_flow_that_moves_at_specks(kind: str, moves: str, specks: str) -> None:
    image1, image2, truth, mask = pair(kind, moves, specks)
    images, flow = (tensor(image1), tensor(image2)), tensor(truth)
    drawn = near_error(registered(flow, *images, RegistrationConfig()), truth, mask)
    kept = near_error(registered(flow, without_specks(flow, *images), images[1], RegistrationConfig()), truth, mask)
    assert kept < 0.1 < drawn


def test_specks_side_by_side_do_not_speak_for_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    here, dots = sys.modules[__name__], gel
    monkeypatch.setattr(here, "PLACES", ((86, 62), (96, 62), (106, 62), (86, 78), (96, 78), (106, 78)))
    monkeypatch.setattr(here, "gel", lambda kind, x, y: dots(kind, x / 3, y / 3))
    image1, image2, truth, mask = pair("dots", "slow", "disc")
    found = without_specks(tensor(truth), tensor(image1), tensor(image2))
    assert near_error(registered(tensor(truth), found, tensor(image2), RegistrationConfig()), truth, mask) < 0.1


@pytest.mark.parametrize("kind", ["dots", "waves"])
@pytest.mark.parametrize(
    ("moves", "specks"), [("none", "disc"), ("creep", "disc"), ("shift", "none"), ("press", "none"), ("turn", "none")]
)
def test_where_nothing_stands_still_or_all_of_it_does_image_1_is_left(kind: str, moves: str, specks: str) -> None:
    image1, image2, truth, _ = pair(kind, moves, specks)
    for wrong in (0.0, 2.0) if moves == "none" else (0.0,):
        assert torch.equal(without_specks(tensor(truth + wrong), tensor(image1), tensor(image2)), tensor(image1))


def test_the_network_is_used_and_the_denoiser_trained_without_specks(monkeypatch: pytest.MonkeyPatch) -> None:
    image1, image2, truth, mask = pair("waves", "shift", "disc")
    images, flow = (tensor(image1), tensor(image2)), tensor(truth)
    monkeypatch.setattr(GelFlow, "forward", lambda self, *_: [flow])
    config = ModelConfig(levels=4, projected_channels=8, denoise=True, registration=RegistrationConfig())
    assert near_error(GelFlow(config).flow(*images), truth, mask) < 0.3
    module = FlowModule(
        TrainConfig(model=config, supervision="registered", loss=LossConfig(lambda_s=[1, 1, 1])), GelFlow(config)
    )
    near = torch.from_numpy(distance_to(mask) <= REACH_PX)
    _, parts = module._denoising(*images, torch.where(near, flow, torch.nan))
    assert parts["registered"] < 0.3


def test_the_surroundings_of_a_linear_flow_are_that_flow_whatever_a_fifth_of_it_says() -> None:
    x, y = grid(HEIGHT, WIDTH)
    linear = np.stack([0.03 * x - 0.02 * y + 2, 0.01 * x + 0.04 * y - 3], axis=-1)
    holes = (np.random.default_rng(0).random((HEIGHT // 12, WIDTH // 12)) < 0.2).repeat(12, 0).repeat(12, 1)
    flow, texture = tensor(np.where(holes[..., None], 0, linear)), torch.ones(1, 1, HEIGHT, WIDTH)
    found, misfit = surroundings(flow, texture, texture)
    inner = (..., slice(24, -24), slice(24, -24))
    # Cauchy's weight of an outlier by r is (s / r)^2: a fifth of 3 px at s = .5 px pulls by some .02 to .1 px.
    assert (found - tensor(linear))[inner].abs().max() < 0.3
    assert misfit[inner].max() < 1.0


def test_best_is_right_near_specks() -> None:
    """It was trained with them; "fast", which was not, follows them."""
    image1, image2, truth, mask = pair("dots", "shift", "bubble")
    near = distance_to(mask) <= REACH_PX
    models = (gelflow.load_model(name, device="cpu") for name in ("best", "fast"))
    flows = (model.flow(image1.astype(np.float32), image2.astype(np.float32)) for model in models)
    best, fast = ((np.linalg.norm(flow - truth, axis=-1) > 1)[near].mean() for flow in flows)
    assert best < 0.05
    assert fast > 0.2, "the specks do nothing"
