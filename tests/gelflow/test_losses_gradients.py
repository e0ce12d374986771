"""Every term of the loss that a user can choose, alone, against finite differences in float64."""

import pytest
import torch
from torch.autograd import gradcheck

from gelflow.config import LossConfig
from gelflow.losses import self_supervised_loss
from gelflow.losses.endpoint import endpoint_loss

ALONE = {"alpha": 0.5, "lambda_dc": 0.0, "lambda_df": 0.0}
REGULARISER = {"alpha": 0.0, "lambda_dc": 3.0, "lambda_df": 0.0}
TERMS = {
    "absolute difference": {**ALONE, "alpha": 0.0},
    "structural similarity": {**ALONE, "alpha": 1.0},
    "spline": {**ALONE, "warping": "spline"},
    "on the images": {**ALONE, "compare_at": "image"},
    "decomposition": REGULARISER,
    "decomposition, in px": {**REGULARISER, "flow_normalisation": "none"},
    "edge-aware weight": {**REGULARISER, "weight": "edge_aware"},
    "floored weight": {**REGULARISER, "weight": "floor", "weight_floor": 0.9},
    "deformation": {**REGULARISER, "lambda_dc": 0.0, "lambda_df": 3.0},
    "deformation, determinant": {**REGULARISER, "lambda_dc": 0.0, "lambda_df": 3.0, "ratio": "det"},
    "first order": {**REGULARISER, "smoothness": "first_order"},
    "second order": {**REGULARISER, "smoothness": "second_order"},
    "second order, its own weights": {**REGULARISER, "smoothness": "second_order", "smoothness_s": (0.0, 2.0)},
}


@pytest.mark.parametrize("masked", [False, True], ids=["all pixels", "some hidden"])
@pytest.mark.parametrize("term", list(TERMS))
def test_the_gradient_is_that_of_finite_differences(term: str, masked: bool) -> None:
    """Fails, where a term is detached, with an analytical gradient of zero."""
    random = torch.Generator().manual_seed(5)
    # Of little contrast, so that weights exp(-10 |grad I|) do not vanish.
    images = (0.4 + 0.2 * torch.rand(2, 1, 3, 9, 10, generator=random, dtype=torch.float64)).unbind()
    # Away from the kinks of interpolation, at whole numbers of px at both scales, and from the image's border.
    flows = [
        (0.15 + 0.2 * torch.rand(1, 2, *size, generator=random, dtype=torch.float64)).requires_grad_()
        for size in ((9, 10), (5, 5))
    ]
    visible = None
    if masked:
        visible = torch.ones(1, 1, 9, 10, dtype=torch.float64)
        visible[..., :2], visible[..., 8, :] = 0.0, 0.0
    config = LossConfig(lambda_s=(1.0, 0.5), **TERMS[term])

    def loss(*fields: torch.Tensor) -> torch.Tensor:
        return self_supervised_loss(list(fields), *images, config, visible)[0]

    assert gradcheck(loss, flows)
    finest, _ = torch.autograd.grad(loss(*flows), flows)
    assert finest.abs().max() > 1e-4  # not the agreement of two zeros


def test_the_endpoint_loss_pulls_towards_the_truth_with_unit_length() -> None:
    """Its gradient is the direction to the truth over the number of pixels; at the truth it vanishes."""
    random = torch.Generator().manual_seed(6)
    truth = torch.randn(1, 2, 4, 5, generator=random, dtype=torch.float64)
    angle = 6.3 * torch.rand(1, 1, 4, 5, generator=random, dtype=torch.float64)
    length = 0.5 + torch.rand(1, 1, 4, 5, generator=random, dtype=torch.float64)
    flow = (truth + length * torch.cat([angle.cos(), angle.sin()], dim=1)).requires_grad_()
    assert gradcheck(lambda f: endpoint_loss(f, truth), (flow,))
    (gradient,) = torch.autograd.grad(endpoint_loss(flow, truth), flow)
    away = (flow - truth).detach()
    # |d| / sqrt(d^2 + 0.01^2) differs from 1 by 5e-5 / d^2, and d is at least 0.5 px.
    torch.testing.assert_close(20 * gradient, away / away.norm(dim=1, keepdim=True), rtol=0, atol=2.1e-4)
    at_truth = truth.clone().requires_grad_()
    assert not torch.autograd.grad(endpoint_loss(at_truth, truth), at_truth)[0].any()
