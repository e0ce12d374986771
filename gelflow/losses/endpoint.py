"""Endpoint loss for training on the exact flow: ``sqrt(|V - V*|^2 + e^2) - e``, differentiable at zero, e = 0.01 px.

Pixels that see no gel (NaN in the true flow) do not count; pixels whose point is hidden or outside in the other image
do, since their true motion is known.
"""

import torch

from gelflow.arrays import Flow, Scalar

SOFTNESS_PX = 0.01
"""e: below this error the loss turns from linear to quadratic."""


def endpoint_loss(flow: Flow, truth: Flow) -> Scalar:
    """Mean softened distance of a flow from the truth at one scale, px; 0 where nothing is known."""
    known = torch.isfinite(truth).all(dim=1, keepdim=True)
    squared = (flow - torch.where(known, truth, flow.detach())).square().sum(dim=1, keepdim=True)
    distance = torch.sqrt(squared + SOFTNESS_PX**2) - SOFTNESS_PX
    return (distance * known).sum() / known.sum().clamp(min=1)
