"""Consistency there and back: a patch that is lost one way is found by the other, and nothing else is touched."""

import pytest
import torch
from torch import Tensor
from waves import moved_pair, press_flow

from gelflow.arrays import Flow, Images
from gelflow.config import RegistrationConfig
from gelflow.models.estimate import consistent, inverse
from gelflow.ops.warp import warp

PATCH = (..., slice(36, 60), slice(50, 78))
JUMP_PX = 14.0


def example() -> tuple[Images, Images, Flow, Flow]:
    """Images, flow and flow back of a press of 6 px, each (1, ., 96, 128); the flow back by fixed-point iteration."""
    flow = press_flow(96, 128, 6.0)
    image1, image2 = (image.float()[None] for image in moved_pair(flow, seed=0))
    there = flow.float()[None]
    back = -there
    for _ in range(60):
        back = -warp(there, back)
    return image1, image2, there, back


def lost(flow: Flow) -> Flow:
    wrong = flow.clone()
    wrong[PATCH] += JUMP_PX
    return wrong


def error(flow: Flow, truth: Flow) -> Tensor:
    return (flow - truth)[PATCH].norm(dim=1).mean()


def test_inverse_of_a_press() -> None:
    _, _, there, back = example()
    found = (inverse(there) - back).norm(dim=1)[..., 8:-8, 8:-8]
    # Each pixel takes what ends within half a pixel of it: an error of the flow's slope, at most 1, times 0.7 px.
    assert found.max() < 0.7
    assert found.mean() < 0.05
    assert torch.isfinite(inverse(torch.full((1, 2, 64, 64), 500.0))).all()


def test_a_lost_patch_is_taken_from_the_flow_back() -> None:
    image1, image2, there, back = example()
    found = consistent(lost(there), image1, image2, lambda *_: back, RegistrationConfig())
    assert error(lost(there), there) > 19
    assert error(found, there) < 0.1
    calls: list[Images] = []  # Of a batch only the pair that is torn is examined

    def estimate(first: Images, second: Images) -> Flow:
        calls.append(first)
        return back

    both = (torch.cat([image, image]) for image in (image1, image2))
    batch = consistent(torch.cat([there, lost(there)]), *both, estimate, RegistrationConfig())
    assert torch.equal(batch, torch.cat([there, found]))
    assert [torch.equal(call, image2) for call in calls] == [True]


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_flow_is_kept_where_the_flow_back_is_lost(noise: float) -> None:
    image1, image2, there, back = example()
    image2 = image2 + noise * torch.randn(image2.shape, generator=torch.Generator().manual_seed(0))
    torn = there.clone()
    torn[..., :2, :] += JUMP_PX  # examined, though right where it does not close
    found = consistent(torn, image1, image2, lambda *_: lost(back), RegistrationConfig())
    assert torch.equal(found[PATCH], torn[PATCH])


def test_without_evidence_the_flow_is_kept() -> None:
    grey, flow = torch.full((1, 3, 96, 128), 0.5), lost(torch.zeros(1, 2, 96, 128))
    found = consistent(flow, grey, grey, lambda *_: torch.zeros_like(flow), RegistrationConfig())
    assert torch.equal(found, flow)
