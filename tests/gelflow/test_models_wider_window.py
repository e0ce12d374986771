"""The window that fits the place: noise falls as it should, the error is known, and a step in a flow stays."""

import pytest
import torch

from gelflow.models.wider_window import TWO_STEPS, best_window
from gelflow.ops.gaussian import window_sums

SIZE, NARROW, NOISE = (160, 200), 5.0, 0.05
INSIDE = (..., slice(40, -40), slice(40, -40))
TEXTURE = torch.ones(1, 1, *SIZE)


def noise_of_two_steps(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Noise of a flow (1, 2, H, W) after two steps in a narrow window, and its variance."""
    window = window_sums(TEXTURE, NARROW)
    white = NOISE * torch.randn((1, 2, *SIZE), generator=torch.Generator().manual_seed(seed))
    step = window(white) / window(TEXTURE)
    # A Gaussian mean has the variance of white noise over 4 pi 5^2 px, for each of two components.
    variance = TWO_STEPS * 2 * NOISE**2 / (4 * torch.pi * NARROW**2)
    return 2 * step - window(step) / window(TEXTURE), torch.full_like(TEXTURE, variance)


def test_noise_is_smoothed_as_far_as_theory_says_and_the_error_is_known() -> None:
    before, after, said = [], [], []
    for seed in range(6):
        flow, variance = noise_of_two_steps(seed)
        found, error = best_window(flow, variance, 9 * TEXTURE, NARROW)
        before.append((flow.square().sum(dim=1) / variance[0])[INSIDE].mean())
        after.append(found.square().sum(dim=1)[INSIDE].mean())
        said.append(error[INSIDE].mean())
    # 6 x 80 x 120 px with 4 pi 5^2 / (11 / 6) px for each independent value: 6 %.
    assert torch.stack(before).mean().item() == pytest.approx(1, rel=0.12)
    # Under 20 px the variance is (5 / 20)^2 of that under 5 px, for the same kernel.
    ratio = (torch.stack(after).mean() / variance.mean()).item()
    assert ratio < 1.5 / 16
    assert torch.stack(said).mean().item() == pytest.approx(ratio * variance.mean().item(), rel=0.5)


def test_what_bends_more_than_noise_stays() -> None:
    noise, variance = noise_of_two_steps(0)
    flow = noise.clone()
    flow[..., 100:] += 1.0
    found, _ = best_window(flow, variance, 9 * TEXTURE, NARROW)
    # The step is a hundred times the noise: no window that reaches it has the smaller risk.
    assert torch.equal(found[..., 90:110], flow[..., 90:110])
    assert found[..., :20].square().mean() < 0.5 * flow[..., :20].square().mean()
