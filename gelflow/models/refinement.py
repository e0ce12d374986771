"""Refinement head: corrects the decoded flow at half of the resolution by what local correlation finds there.

Each iteration warps the second image's fine features by the flow so far, correlates within 3 px, and adds a correction
computed by three convolutions that all iterations share. It is not part of the paper, whose finest flow is an
enlargement of a quarter of the resolution.
"""

import torch
import torch.nn.functional as F
from torch import nn

from gelflow.arrays import Features, Flow
from gelflow.models.encoder import CHANNELS
from gelflow.models.layers import SLOPE, convolution, flow_head
from gelflow.ops.correlation import local_correlation
from gelflow.ops.warp import warp

RADIUS = 3
CHANNELS_WITHIN = 48
ITERATIONS = 3


class RefinementHead(nn.Module):
    """Corrections of the flow at half of the resolution."""

    def __init__(self) -> None:
        super().__init__()
        inputs = (2 * RADIUS + 1) ** 2 + CHANNELS[0] + 2
        self.layers = nn.Sequential(
            convolution(inputs, CHANNELS_WITHIN), convolution(CHANNELS_WITHIN, CHANNELS_WITHIN, dilation=2)
        )
        self.head = flow_head(CHANNELS_WITHIN)

    def forward(self, flow: Flow, encoded: Features) -> Flow:
        """Corrects a flow.

        Flow and features, those of both images (2 B, C, H, W), are of the scale s = 1.
        """
        # Unit length: a correlation near one says "here", whatever the contrast.
        first, second = F.normalize(encoded.float(), dim=1).split(flow.shape[0])
        for _ in range(ITERATIONS):
            costs = encoded.shape[1] * local_correlation(first, warp(second, flow), RADIUS)
            evidence = torch.cat([F.leaky_relu(costs, SLOPE), first, flow], dim=1)
            flow = flow + self.head(self.layers(evidence)).float()
        return flow
