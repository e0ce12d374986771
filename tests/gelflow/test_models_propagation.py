"""A lost patch of flow, and flow that is right, under `gelflow.models.propagation`."""

import numpy as np
import pytest
import torch
from textures import grid, texture
from torch import Tensor

from gelflow.models.propagation import propagated

HEIGHT, WIDTH, NOISE = 96, 128, 0.01
SHIFT, WRONG = (3.0, -2.0), torch.tensor([9.0, 7.0]).view(2, 1, 1)


def moved_texture() -> tuple[Tensor, Tensor, Tensor]:
    """Image 1, image 2 and the flow (1, 2, H, W): white noise moved by whole pixels, with a camera's noise in it."""
    generator = np.random.default_rng(3)
    image1 = generator.uniform(0.2, 0.8, (1, 3, HEIGHT, WIDTH))
    image2 = np.roll(image1, (int(SHIFT[1]), int(SHIFT[0])), axis=(2, 3)) + generator.normal(0, NOISE, image1.shape)
    flow = torch.tensor(SHIFT).view(1, 2, 1, 1).expand(1, 2, HEIGHT, WIDTH).clone()
    return torch.from_numpy(image1).float(), torch.from_numpy(image2).float(), flow


def spread(flow: Tensor, *distances: int) -> Tensor:
    image1, image2, _ = moved_texture()
    return propagated(flow, image1, image2, 3.0, distances, NOISE, ignore_shading=False)


@pytest.mark.parametrize("ignore_shading", [False, True])
def test_noise_moves_nothing(ignore_shading: bool) -> None:
    """Two grey images with a camera's noise: all flows are alike."""
    grey = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
    noise = NOISE * torch.randn(grey.shape, generator=torch.Generator().manual_seed(0))
    flow = torch.randn((1, 2, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(1))
    assert torch.equal(propagated(flow, grey, grey + noise, 3.0, (8, 16), NOISE, ignore_shading), flow)


def test_without_a_match_flows_stay() -> None:
    """Images that have nothing to do with each other. A residual is the mean of some 3 x 113 squares, so that two of
    them differ by 7 % or so, rarely by a sixth.
    """
    image1, _, _ = moved_texture()
    other = torch.rand(image1.shape, generator=torch.Generator().manual_seed(0))
    flow = torch.zeros((1, 2, HEIGHT, WIDTH))
    flow[..., 64:] = 5.0
    found = propagated(flow, image1, other, 3.0, (8, 16), NOISE, ignore_shading=False)
    assert (found != flow).float().mean() < 0.03


@pytest.mark.parametrize("lost", [(slice(40, 56), slice(None)), (slice(None), slice(60, 76))], ids=["rows", "columns"])
def test_a_lost_strip_takes_the_flow_beside_it_and_nothing_that_was_not_there_is_found(
    lost: tuple[slice, slice],
) -> None:
    _, _, truth = moved_texture()
    flow = truth.clone()
    flow[..., lost[0], lost[1]] = WRONG
    assert torch.equal(spread(flow, 16), truth)
    flow = torch.zeros_like(truth)
    flow[..., lost[0], lost[1]] = 5.0
    found = spread(flow, 8, 16)
    assert ((found == 0) | (found == 5)).all()


def test_a_gels_flow_is_extrapolated() -> None:
    """A stretched texture of which a strip of 12 px is lost, under a window that reduces images to a quarter."""
    x, y = grid(HEIGHT, WIDTH)
    u = 0.1 * (x - WIDTH / 2)
    image1, image2 = (
        torch.from_numpy(texture(*places)).permute(2, 0, 1)[None] for places in ((x + u, y), (x, y))
    )  # fmt: skip
    truth = torch.from_numpy(np.stack([u, np.zeros_like(u)])).float()[None]
    flow = truth.clone()
    flow[..., 58:70] += WRONG
    found = propagated(flow, image1, image2, 12.0, (32,), NOISE, ignore_shading=True)
    error = (found - truth).norm(dim=1)
    assert error[..., 62:66].max() < 0.3  # the edges are interpolated over four px
    assert max(error[..., 40:52].max(), error[..., 76:88].max()) < 1e-5


def test_light_is_ignored_or_followed() -> None:
    """A lamp that is switched on at the right. Beside it there is a flow that would find as bright a place, and no
    better a pattern.
    """
    image1, image2, truth = moved_texture()
    flow = truth.clone()
    ramp = torch.linspace(0, 1, WIDTH).expand(1, 3, HEIGHT, WIDTH)
    flow[..., :32] = torch.tensor([-24.0, 0.0]).view(2, 1, 1)
    grey1, grey2 = 0.1 * image1 + 0.4 * ramp, 0.1 * image2 + 0.4 * ramp + 0.075
    motion, brightness = (
        propagated(flow, grey1, grey2, 3.0, (8, 16, 32), NOISE, ignore_shading) for ignore_shading in (True, False)
    )
    assert torch.equal(motion[..., 48:], flow[..., 48:])
    assert (brightness[..., 48:] != flow[..., 48:]).float().mean() > 0.1
