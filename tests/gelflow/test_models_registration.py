"""Registration, propagation, consistency: true flow is reached and kept, lost patches are found, light is ignored."""

from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused
from textures import grid, texture
from torch import Tensor
from waves import Shifts

from gelflow.config import REGISTRATIONS, ModelConfig, RegistrationConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.models import GelFlow, registration
from gelflow.models.estimate import estimate_flow
from gelflow.models.propagation import propagated, windowed_residual
from gelflow.models.registration import registered
from gelflow.models.weights import load_weights, save_weights
from gelflow.ops.gaussian import window_sums
from gelflow.ops.warp import warp
from gelflow.training import train

HEIGHT, WIDTH = 96, 128
MOTION, BOTH, BRIGHTNESS = RegistrationConfig(), REGISTRATIONS["both"], REGISTRATIONS["brightness"]
NOISE = 0.01
SHIFT, WRONG = (3.0, -2.0), torch.tensor([9.0, 7.0]).view(2, 1, 1)


def pair(size: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Images with a smooth flow of up to `size` px, exact: image 1 is the texture at the moved places."""
    x, y = grid(HEIGHT, WIDTH)
    u, v = size * np.sin(np.pi * x / WIDTH), size * np.cos(np.pi * y / HEIGHT) * np.sin(np.pi * x / WIDTH)
    image1, image2 = (torch.from_numpy(im).permute(2, 0, 1)[None] for im in (texture(x + u, y + v), texture(x, y)))
    return image1, image2, torch.from_numpy(np.stack([u, v])).float()[None]


def shade(column: float, row: float, radius: float) -> Tensor:
    x, y = grid(HEIGHT, WIDTH)
    return torch.from_numpy(np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * radius**2))).float()


def error(flow: Tensor, truth: Tensor) -> float:
    return (flow - truth).norm(dim=1).mean().item()


@pytest.mark.parametrize("config", [MOTION, BOTH, BRIGHTNESS], ids=["motion", "both", "brightness"])
def test_it_finds_the_flow_from_none_and_keeps_it(config: RegistrationConfig) -> None:
    image1, image2, truth = pair()
    start = torch.zeros_like(truth)
    assert error(start, truth) > 0.6
    # What the last smoothing, by 2 px, takes of a motion that turns within 100 px is worth 0.01 px.
    assert error(registered(start, image1, image2, config), truth) < 0.02
    assert error(registered(truth, image1, image2, config), truth) < 0.01


def test_texture_reduces_noise_and_finds_a_lost_patch_and_without_it_the_flow_stays() -> None:
    image1, image2, truth = pair()
    noise = 0.2 * torch.randn(truth.shape, generator=torch.Generator().manual_seed(0))
    # White noise under a Gaussian of 8 px keeps 1 / (2 sqrt(pi) 8) = 4 % of its height, before any texture.
    assert error(registered(truth + noise, image1, image2, MOTION), truth) < 0.01
    lost = truth.clone()
    lost[..., 40:60, 60:80] += 14.0
    assert error(registered(lost, image1, image2, MOTION), truth) < 0.1
    grey, flow = torch.full((1, 3, 64, 64), 0.5), torch.full((1, 2, 64, 64), 1.5)
    torch.testing.assert_close(registered(flow, grey, grey, MOTION), flow, rtol=0, atol=1e-4)
    flow = torch.full((1, 2, HEIGHT, WIDTH), 200.0)
    torch.testing.assert_close(registered(flow, image1, image2, MOTION), flow, rtol=0, atol=1e-3)


@pytest.mark.parametrize("iterations", [1, 20])
@pytest.mark.parametrize("prior", [0.01, 0.1])
def test_an_error_of_the_flow_is_weighed_against_the_images_as_the_prior_says(iterations: int, prior: float) -> None:
    """At one wave: d = x g / (g + s² / p²), after one step, and where all steps end."""
    wave, off = 0.02, 0.05
    x, _ = grid(64, 64)
    image = torch.from_numpy(0.5 + wave * np.sin(2 * np.pi * x / 16)).float().expand(1, 3, 64, 64)
    flow = torch.tensor([off, 0.0]).view(1, 2, 1, 1).repeat(1, 1, 64, 64)
    one = {"windows_px": (4,), "smoothing_px": (0,), "background_px": None, "noise": 0.01}
    config = RegistrationConfig(**one, iterations=iterations, prior_px=prior)
    found = registered(flow, image, image, config)[0, 0, 32, 32].item()
    gradient2 = (wave * np.sin(2 * np.pi / 16)) ** 2 / 2  # mean square of a central difference
    texture = 3 * 2 * np.pi * 4**2 * gradient2
    variance = gradient2 * off**2 + 0.01**2
    # Sums of squares over a window of four pixels differ from half by exp(-2 (4 · 2 π / 16)²) = 0.7 %.
    assert found == pytest.approx(off - off * texture / (texture + variance / prior**2), abs=0.04 * off)


def test_shading_is_ignored_unless_asked_for_and_equal_brightness_elsewhere_does_not_spread() -> None:
    image1, image2, truth = pair()
    lit = 0.7 * image2 + 0.15 * shade(60, 50, 15)
    motion, brightness = (error(registered(truth, 0.7 * image1, lit, aim), truth) for aim in (MOTION, BRIGHTNESS))
    assert motion < 0.1  # Under the background's 4 px a shade of 15 px keeps (4 / 15)² = 7 % of its curvature
    assert brightness > 4 * motion
    # On a bare gel, a shade of 12 px that darkens where it is.
    bare, still = 0.1 * shade(54, 50, 12).expand(1, 3, -1, -1), torch.zeros_like(truth)
    assert error(registered(still, 0.4 + bare, 0.4 + 1.5 * bare, MOTION), still) < 0.05
    # Other light on a faint texture; at the left a flow leads to where image 2 is as bright as image 1.
    ramp = torch.linspace(0, 0.64, WIDTH)
    dim, lit = 0.25 * image1 + ramp, 0.25 * image2 + ramp + 0.64 / (WIDTH - 1) * 18
    lost = truth.clone()
    lost[..., :24] = torch.tensor([-18.0, 0.0]).view(2, 1, 1)
    assert error(registered(lost, dim, lit, MOTION)[..., 60:], truth[..., 60:]) < 0.1


def test_where_the_flow_bends_a_finer_window_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = grid(HEIGHT, WIDTH)
    u = 0.5 * np.sin(2 * np.pi * x / 32)
    image1, image2 = (torch.from_numpy(im).permute(2, 0, 1)[None] for im in (texture(x + u, y), texture(x, y)))
    truth = torch.from_numpy(np.stack([u, 0 * u])).float()[None]
    found = registered(torch.zeros_like(truth), image1, image2, MOTION)
    monkeypatch.setattr(registration, "bends", lambda *_: torch.tensor(False))
    assert error(found, truth) < 0.7 * error(registered(torch.zeros_like(truth), image1, image2, MOTION), truth)


def test_what_came_first_stays_where_it_explains_the_images() -> None:
    """A shade in one place, a broken pixel in another."""
    image1, image2, truth = pair()
    x, y = grid(HEIGHT, WIDTH)
    distance = torch.from_numpy(np.hypot(x - 56, y - 48))
    lit = image2 + 0.2 * shade(56, 48, 8)
    lit[..., 10, 10] += 0.5
    motion, found = (registered(truth, image1, lit, aim) for aim in (MOTION, BOTH))
    # The shade is at 0.001 from 26 px on; the window's three standard deviations and the edge's reach 24 px further.
    assert torch.equal(found[..., distance > 50], motion[..., distance > 50])
    bright = registered(motion, image1, lit, BRIGHTNESS)
    apart = (bright - motion).abs() > 0.05
    share = ((found - motion) / (bright - motion))[apart]
    assert -1e-3 < share.min() < share.max() < 1 + 1e-3
    assert ((share > 0.3) & (share < 0.7)).sum() > 20
    left = [(warp(lit, flow, "spline") - image1).square().mean(dim=1)[0, distance < 10] for flow in (found, motion)]
    assert left[0].mean() < 0.7 * left[1].mean()


def test_pairs_of_a_batch_do_not_see_each_other() -> None:
    image1, image2, truth = pair()
    both = [torch.cat([image, image.flip(-1)]) for image in (image1, image2)]
    start = torch.zeros_like(truth)
    together = registered(torch.cat([start, start]), *both, MOTION)
    torch.testing.assert_close(together[:1], registered(start, image1, image2, MOTION), rtol=0, atol=1e-4)
    mirrored = together[1:].flip(-1) * torch.tensor([-1.0, 1.0]).view(1, 2, 1, 1)
    # Rounding may turn the choice of a window at a place, of which there are 3,072.
    assert (mirrored - together[:1]).abs().quantile(0.998) < 1e-3


def test_weights_keep_it_a_fine_tuning_may_switch_it_on_and_it_is_set_field_by_field(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    plain, path = GelFlow(ModelConfig(levels=4)), tmp_path / "plain.safetensors"
    save_weights(path, plain)
    image1, image2, truth = pair()
    assert error(estimate_flow(plain, image1, image2), truth) > 0.5  # untrained: next to no motion
    settings = {"windows_px": (12, 6), "smoothing_px": (2, 2), "prior_px": 1.0}
    values = plain.config.model_dump() | {"registration": settings}
    config = TrainConfig(model=values, steps=1, batch_size=1, learning_rate=1e-9, device="cpu",
                         loss={"lambda_s": (1, 0, 0)})  # fmt: skip
    pairs = Shifts(1, 64, 1.0, seed=1)
    network = load_weights(train(config, pairs, None, tmp_path / "run", initial=path).weights)
    assert network.config.registration == RegistrationConfig.model_validate(settings)
    assert error(estimate_flow(network, image1, image2), truth) < 0.1
    other = config.model_copy(update={"model": ModelConfig.model_validate(values | {"lffm": False})})
    refused("lffm: True there, False here", train, other, pairs, None, tmp_path / "other", initial=path)
    start = {"model": ModelConfig().model_dump()}
    config = train_config(None, ["model.registration.prior_px=0.3", "model.registration.iterations=3"], start=start)
    assert config.model.registration == RegistrationConfig(prior_px=0.3, iterations=3)
    for assignment, words in (
        ("windows_px=[]", "at least one"), ("windows_px=[3]", "one number each"), ("prior_px=0", "prior_px"),
        ("smoothing_px=[1, 1, -1]", "at least 0"), ("windows_px=[3, 3, 0.5]", "at least 1"),
    ):  # fmt: skip
        refused(words, train_config, None, [f"model.registration.{assignment}"], start=start)


def moved_texture() -> tuple[Tensor, Tensor, Tensor]:
    """Image 1, image 2 and the flow (1, 2, H, W): white noise moved by whole pixels, with a camera's noise in it."""
    generator = np.random.default_rng(3)
    image1 = generator.uniform(0.2, 0.8, (1, 3, HEIGHT, WIDTH))
    image2 = np.roll(image1, (int(SHIFT[1]), int(SHIFT[0])), axis=(2, 3)) + generator.normal(0, NOISE, image1.shape)
    flow = torch.tensor(SHIFT).view(1, 2, 1, 1).expand(1, 2, HEIGHT, WIDTH).clone()
    return torch.from_numpy(image1).float(), torch.from_numpy(image2).float(), flow


def spread(flow: Tensor, *distances: int) -> Tensor:
    image1, image2, _ = moved_texture()
    return propagated(flow, image1, image2, 3.0, BRIGHTNESS.model_copy(update={"propagation_px": distances}))


@pytest.mark.parametrize("config", [MOTION, BRIGHTNESS])
def test_between_grey_images_noise_moves_nothing(config: RegistrationConfig) -> None:
    grey = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
    noise = config.noise * torch.randn(grey.shape, generator=torch.Generator().manual_seed(0))
    flow = torch.randn((1, 2, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(1))
    assert torch.equal(propagated(flow, grey, grey + noise, 3.0, config), flow)


def test_without_a_match_flows_stay() -> None:
    image1, clipped, flow = moved_texture()
    clipped[..., 64:] = 1.0
    flow[..., 70:] += 20.0  # to where image 2 is white: the residual is the texture of image 1 alone
    near = RegistrationConfig(propagation_px=(8, 16), noise=NOISE)
    assert torch.equal(propagated(flow, image1, clipped, 3.0, near), flow)
    other = torch.rand(image1.shape, generator=torch.Generator().manual_seed(0))
    flow = torch.zeros((1, 2, HEIGHT, WIDTH))
    flow[..., 64:] = 5.0
    found = propagated(flow, image1, other, 3.0, near.model_copy(update={"background_px": None}))
    # A residual is the mean of some 3 x 113 squares, so that two differ by 7 % or so, rarely by a sixth.
    assert (found != flow).float().mean() < 0.03


def test_a_window_counts_that_keeps_three_tenths_of_its_weight_in_the_image() -> None:
    image, flow, column = torch.rand(1, 3, 4, 60), torch.tensor([20.0, 0.0]).view(1, 2, 1, 1), np.arange(60)
    left = windowed_residual(flow.expand(1, 2, 4, 60), image, image, window_sums(image, 6.0), True)
    weight = np.exp(-((column[:, None] - column) ** 2) / (2 * 6.0**2)) * (abs(column[:, None] - column) <= 18)
    share = weight[:, column + 20 <= 59].sum(axis=1) / weight.sum(axis=1)
    assert abs(share - 0.3).min() > 0.01
    assert (left.isfinite().numpy() == (share > 0.3)).all()


@pytest.mark.parametrize("lost", [(slice(40, 56), slice(None)), (slice(None), slice(60, 76))], ids=["rows", "columns"])
def test_a_lost_strip_takes_the_flow_beside_it_and_nothing_that_was_not_there_is_found(lost) -> None:
    _, _, truth = moved_texture()
    flow = truth.clone()
    flow[..., lost[0], lost[1]] = WRONG
    assert torch.equal(spread(flow, 16), truth)
    flow = torch.zeros_like(truth)
    flow[..., lost[0], lost[1]] = 5.0
    found = spread(flow, 8, 16)
    assert ((found == 0) | (found == 5)).all()


def test_a_gels_flow_is_extrapolated_and_light_ignored_or_followed() -> None:
    """A stretched texture of which a strip of 12 px is lost, under a window that reduces images to a quarter."""
    x, y = grid(HEIGHT, WIDTH)
    u = 0.1 * (x - WIDTH / 2)
    image1, image2 = (torch.from_numpy(texture(*p)).permute(2, 0, 1)[None] for p in ((x + u, y), (x, y)))
    truth = torch.from_numpy(np.stack([u, np.zeros_like(u)])).float()[None]
    flow = truth.clone()
    flow[..., 58:70] += WRONG
    found = propagated(flow, image1, image2, 12.0, RegistrationConfig(noise=NOISE))
    error = (found - truth).norm(dim=1)
    assert error[..., 62:66].max() < 0.3  # the edges are interpolated over four px
    assert max(error[..., 40:52].max(), error[..., 76:88].max()) < 1e-5
    image1, image2, truth = moved_texture()
    flow = truth.clone()
    ramp = torch.linspace(0, 1, WIDTH).expand(1, 3, HEIGHT, WIDTH)
    flow[..., :32] = torch.tensor([-24.0, 0.0]).view(2, 1, 1)
    grey1, grey2 = 0.1 * image1 + 0.4 * ramp, 0.1 * image2 + 0.4 * ramp + 0.075
    motion, brightness = (propagated(flow, grey1, grey2, 3.0, config) for config in (MOTION, BRIGHTNESS))
    assert torch.equal(motion[..., 48:], flow[..., 48:])
    assert (brightness[..., 48:] != flow[..., 48:]).float().mean() > 0.1
