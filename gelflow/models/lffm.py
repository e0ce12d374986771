"""Local flow fusion module (paper, section 3.2): a flow smoothed where neighbouring context features agree.

``V'(x) = sum_d w(x, d) V(x + d)``,  ``w(x, .) = softmax_d( k <C(x), C(x + d)> )`` over the neighbours d of a 3x3 window
that lie inside the image. The paper has k = 1; here k = 1/sqrt(number of channels), as in scaled dot-product attention,
because with k = 1 the weight of the centre tends to one as features grow. Neighbours beyond the border get no weight,
so a constant flow stays exactly as it is, and every fused flow lies between the flows that it was made from.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gelflow.arrays import Features, Flow
from gelflow.ops.correlation import local_correlation


class LocalFlowFusion(nn.Module):
    """Local flow fusion; the module has no parameters."""

    def weights(self, context: Features) -> Tensor:
        """Weight of each neighbour, (B, 9, H, W), row by row; at every pixel they sum to one."""
        channels, height, width = context.shape[1:]
        similarity = math.sqrt(channels) * local_correlation(context, context, 1)  # which is a mean over C
        beyond = F.unfold(context.new_ones(1, 1, height, width), 3, padding=1).view(1, 9, height, width) == 0
        return torch.softmax(similarity.masked_fill(beyond, -torch.inf), dim=1)

    def forward(self, flow: Flow, context: Features) -> Flow:
        """Fuses a flow (B, 2, H, W) by the context (B, C, H, W)."""
        batch, _, height, width = flow.shape
        neighbours = F.unfold(flow, 3, padding=1).view(batch, 2, 9, height, width)
        return (neighbours * self.weights(context).unsqueeze(1)).sum(dim=2)
