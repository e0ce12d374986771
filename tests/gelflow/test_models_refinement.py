"""The refinement head: shapes, gradient, and that it starts as next to no change."""

import pytest
import torch

from gelflow.config import ModelConfig
from gelflow.models import GelFlow


def test_it_corrects_its_scale_and_the_finer_one() -> None:
    """Fails with the finer scales enlarged from the unrefined flow."""
    torch.manual_seed(0)
    network = GelFlow(ModelConfig(levels=4, refine="half", refine_iterations=2))
    images = torch.rand(2, 1, 3, 66, 71).unbind()
    flows = network(*images)
    assert [tuple(flow.shape[2:]) for flow in flows] == [(66, 71), (33, 36), (17, 18)]
    before = [flow.detach().clone() for flow in flows]
    with torch.no_grad():
        network.refinement.head.bias += torch.tensor([0.5, 0.0])
        after = network(*images)
    assert torch.equal(after[2], before[2])
    assert (after[1] != before[1]).any()
    # Two corrections of about 0.5 px at the head's scale, doubled where it is enlarged.
    change = (after[0] - before[0])[:, 0].mean()
    assert change == pytest.approx(2.0, rel=0.1)


def test_its_weights_have_a_gradient() -> None:
    network = GelFlow(ModelConfig(levels=4, refine="half", refine_iterations=1))
    sum(flow.square().mean() for flow in network(*torch.rand(2, 1, 3, 64, 64).unbind())).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in network.refinement.parameters())
    assert network.refinement.layers[0][0].weight.grad.any()


def test_half_resolution_that_is_decoded_already_is_refused() -> None:
    with pytest.raises(ValueError, match="adds nothing to finest_scale = 1"):
        ModelConfig(finest_scale=1, refine="half")
