"""The two networks that estimate the flow of a scale: PWC-Net's estimator in ARFlow's reduced form, and its context.

From the cost volume, the first image's projected features and the flow so far the estimator computes a correction of
the flow and 32 channels of context; each of its layers sees the outputs of the two before it. The context network
refines the flow over a wide area by dilated convolutions. The local flow fusion goes on with the same context.
"""

import torch
from torch import Tensor, nn

from gelflow.arrays import Features, Flow
from gelflow.models.layers import convolution, flow_head

CONTEXT_CHANNELS = 32
"""Channels of the estimator's last features."""
CONTEXT_LAYERS = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))
"""Channels and dilation of each layer of the context network."""


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


class ContextNetwork(nn.Module):
    """Dilated convolutions on the estimator's context and the coarse flow."""

    def __init__(self) -> None:
        super().__init__()
        inputs, layers = CONTEXT_CHANNELS + 2, []
        for outputs, dilation in CONTEXT_LAYERS:
            layers.append(convolution(inputs, outputs, dilation=dilation))
            inputs = outputs
        self.layers = nn.Sequential(*layers, flow_head(inputs))

    def forward(self, context: Features, flow: Flow) -> Tensor:
        """Correction of the flow, (B, 2, H, W) in px of this scale."""
        correction: Tensor = self.layers(torch.cat([context, flow], dim=1))
        return correction
