"""A lost patch of flow, and flow that is right, under `gelflow.models.propagation`."""

import numpy as np
import pytest
import torch
from torch import Tensor

from gelflow.models.propagation import propagated
from gelflow.ops.gaussian import WindowSums
from gelflow.ops.spline import SplineImage

HEIGHT, WIDTH, NOISE = 96, 128, 0.01
SHIFT = (3.0, -2.0)


def moved_texture() -> tuple[Tensor, SplineImage, Tensor]:
    """Image 1, image 2 and the flow (1, 2, H, W): white noise moved by whole pixels, with a camera's noise in it."""
    generator = np.random.default_rng(3)
    image1 = generator.uniform(0.2, 0.8, (1, 3, HEIGHT, WIDTH))
    image2 = np.roll(image1, (int(SHIFT[1]), int(SHIFT[0])), axis=(2, 3)) + generator.normal(0, NOISE, image1.shape)
    flow = torch.tensor(SHIFT).view(1, 2, 1, 1).expand(1, 2, HEIGHT, WIDTH).clone()
    return torch.from_numpy(image1).float(), SplineImage(torch.from_numpy(image2).float()), flow


def spread(flow: Tensor, *distances: int) -> Tensor:
    image1, image2, _ = moved_texture()
    return propagated(flow, image1, image2, WindowSums(HEIGHT, WIDTH, 3.0, flow), distances, NOISE)


def test_noise_moves_nothing() -> None:
    """Two grey images with a camera's noise: all flows are alike. Fails with residuals of noise compared."""
    grey = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
    noise = NOISE * torch.randn(grey.shape, generator=torch.Generator().manual_seed(0))
    flow = torch.randn((1, 2, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(1))
    window = WindowSums(HEIGHT, WIDTH, 3.0, flow)
    assert torch.equal(propagated(flow, grey, SplineImage(grey + noise), window, (8, 16), NOISE), flow)


def test_without_a_match_flows_stay() -> None:
    """Images that have nothing to do with each other. Fails with any lesser residual taken (ENOUGH = 1).

    A residual is the mean of some 3 x 113 squares, so that two of them differ by 7 % or so, rarely by a fifth.
    """
    image1, _, _ = moved_texture()
    other = torch.rand(image1.shape, generator=torch.Generator().manual_seed(0))
    flow = torch.zeros((1, 2, HEIGHT, WIDTH))
    flow[..., 64:] = 5.0
    found = propagated(flow, image1, SplineImage(other), WindowSums(HEIGHT, WIDTH, 3.0, flow), (8, 16), NOISE)
    assert (found != flow).float().mean() < 0.02


@pytest.mark.parametrize("lost", [(slice(40, 56), slice(None)), (slice(None), slice(60, 76))], ids=["rows", "columns"])
def test_a_lost_strip_takes_the_flow_beside_it(lost: tuple[slice, slice]) -> None:
    """Fails with neighbours along one axis only, and with the worst of them taken."""
    _, _, truth = moved_texture()
    flow = truth.clone()
    flow[..., lost[0], lost[1]] = torch.tensor([9.0, 7.0]).view(2, 1, 1)
    assert torch.equal(spread(flow, 16), truth)


def test_a_second_round_reaches_further() -> None:
    """40 px of lost flow, neighbours at 16 px: the middle is reached from what the first round has put right.

    Fails with one round.
    """
    _, _, truth = moved_texture()
    lost = truth.clone()
    lost[..., 28:68, 40:80] = torch.tensor([9.0, 7.0]).view(2, 1, 1)
    assert torch.equal(spread(lost, 16), truth)


def test_nothing_that_was_not_there_is_found() -> None:
    """Fails with any search, or any mean of flows."""
    _, _, truth = moved_texture()
    lost = torch.zeros_like(truth)
    lost[..., 64:] = 5.0
    found = spread(lost, 8, 16)
    assert ((found == 0) | (found == 5)).all()
