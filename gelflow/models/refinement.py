"""Refinement head: corrects the decoded flow at half or at full resolution by what local correlation finds there.

Each iteration warps the second image's fine features by the flow so far, correlates within 3 px, and adds a correction
computed by three convolutions that all iterations share. It is not part of the paper, whose finest flow is an
enlargement of a quarter of the resolution.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gelflow.arrays import Features, Flow, Images
from gelflow.models.encoder import CHANNELS
from gelflow.models.layers import SLOPE, convolution, flow_head
from gelflow.ops.correlation import local_correlation
from gelflow.ops.warp import warp

RADIUS = 3
CHANNELS_WITHIN = 48


class RefinementHead(nn.Module):
    """The head.

    Args:
        scale: 1 (half resolution, with the encoder's features) or 0 (full resolution, with two convolutions of its
            own on the images).
        iterations: Corrections.
    """

    def __init__(self, scale: int, iterations: int) -> None:
        super().__init__()
        channels = CHANNELS[0]
        self.iterations = iterations
        self.features = nn.Sequential(convolution(3, channels), convolution(channels, channels)) if scale == 0 else None
        inputs = (2 * RADIUS + 1) ** 2 + channels + 2
        self.layers = nn.Sequential(
            convolution(inputs, CHANNELS_WITHIN), convolution(CHANNELS_WITHIN, CHANNELS_WITHIN, dilation=2)
        )
        self.head = flow_head(CHANNELS_WITHIN)

    def forward(self, flow: Flow, images: Images, encoded: Features) -> Flow:
        """Corrects a flow.

        Args:
            flow: (B, 2, H, W), px of the head's scale.
            images: Both images, (2 B, 3, ., .), for full resolution.
            encoded: The encoder's features of both at s = 1, (2 B, C, ., .), for half resolution.

        Returns:
            The corrected flow, same shape, float32.
        """
        state: Tensor = encoded if self.features is None else self.features(2 * images - 1)
        # Unit length: a correlation near one says "here", whatever the contrast.
        first, second = F.normalize(state.float(), dim=1).split(flow.shape[0])
        for _ in range(self.iterations):
            costs = state.shape[1] * local_correlation(first, warp(second, flow), RADIUS)
            evidence = torch.cat([F.leaky_relu(costs, SLOPE), first, flow], dim=1)
            flow = flow + self.head(self.layers(evidence)).float()
        return flow
