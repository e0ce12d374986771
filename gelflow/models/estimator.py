"""Coarse flow estimator of PWC-Net in ARFlow's reduced form: each layer sees the outputs of the two before it.

From the cost volume, the first image's projected features and the flow so far it computes a correction of the flow and
32 channels of context, which the context network and the local flow fusion go on with.
"""

import torch
from torch import Tensor, nn

from gelflow.arrays import Features
from gelflow.models.layers import convolution, flow_head

CONTEXT_CHANNELS = 32
"""Channels of the estimator's last features."""


class Estimator(nn.Module):
    """Five densely connected convolutions and a flow head."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.first = convolution(inputs, 128)
        self.second = convolution(128, 128)
        self.third = convolution(128 + 128, 96)
        self.fourth = convolution(128 + 96, 64)
        self.fifth = convolution(96 + 64, CONTEXT_CHANNELS)
        self.head = flow_head(64 + CONTEXT_CHANNELS)

    def forward(self, evidence: Features) -> tuple[Features, Tensor]:
        """Context (B, 32, H, W) and correction of the flow (B, 2, H, W) in px of this scale."""
        one = self.first(evidence)
        two = self.second(one)
        three = self.third(torch.cat([one, two], dim=1))
        four = self.fourth(torch.cat([two, three], dim=1))
        context = self.fifth(torch.cat([three, four], dim=1))
        return context, self.head(torch.cat([four, context], dim=1))
