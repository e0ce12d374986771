"""Feature pyramid of PWC-Net (Sun et al. 2018): one strided and one plain convolution per scale.

Scale s has ceil(H / 2^s) x ceil(W / 2^s) pixels; channels 16, 32, 64, 96, 128, 192 for s = 1 .. 6, then 256.
"""

from itertools import pairwise

from torch import Tensor, nn

from gelflow.arrays import Features, Images
from gelflow.models.layers import convolution

CHANNELS = (16, 32, 64, 96, 128, 192, 256)
"""Feature channels at s = 1 .. 7."""


class Encoder(nn.Module):
    """Features of an image at s = 1 .. levels-1."""

    def __init__(self, levels: int) -> None:
        super().__init__()
        sizes = (3, *CHANNELS[: levels - 1])
        self.scales = nn.ModuleList(
            nn.Sequential(convolution(inputs, outputs, stride=2), convolution(outputs, outputs))
            for inputs, outputs in pairwise(sizes)
        )

    def forward(self, images: Images) -> list[Features]:
        """Features of (B, 3, H, W) images, finest (s = 1) first."""
        features: list[Tensor] = []
        state = 2 * images - 1
        for scale in self.scales:
            state = scale(state)
            features.append(state)
        return features
