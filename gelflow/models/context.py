"""Context network of PWC-Net: dilated convolutions (1, 2, 4, 8, 16, 1) that refine the flow over a wide area."""

import torch
from torch import Tensor, nn

from gelflow.arrays import Features, Flow
from gelflow.models.estimator import CONTEXT_CHANNELS
from gelflow.models.layers import convolution, flow_head

LAYERS = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))
"""Channels and dilation of each layer."""


class ContextNetwork(nn.Module):
    """Correction of the flow from the estimator's context and the coarse flow."""

    def __init__(self) -> None:
        super().__init__()
        inputs, layers = CONTEXT_CHANNELS + 2, []
        for outputs, dilation in LAYERS:
            layers.append(convolution(inputs, outputs, dilation=dilation))
            inputs = outputs
        self.layers = nn.Sequential(*layers, flow_head(inputs))

    def forward(self, context: Features, flow: Flow) -> Tensor:
        """Correction of the flow, (B, 2, H, W) in px of this scale."""
        correction: Tensor = self.layers(torch.cat([context, flow], dim=1))
        return correction
