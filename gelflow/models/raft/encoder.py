"""RAFT's encoder (Teed and Deng 2020, section 3.1): features at an eighth of the image's resolution.

A strided 7x7 convolution, three stages of two residual units each (the second and third stage halve the resolution
once more), and a 1x1 convolution. The large network's units are two 3x3 convolutions, the small one's are bottlenecks
with a quarter of the channels. Names of submodules are those of the published weights, see
`gelflow.models.raft.weights`.
"""

from collections.abc import Callable

from torch import Tensor, nn

from gelflow.arrays import Features, Images

Norm = Callable[[int], nn.Module]
"""Normalisation of so many channels: over each channel of a sample, by the weights' own statistics, or none."""


class ResidualUnit(nn.Module):
    """Two 3x3 convolutions, or a 3x3 one of a quarter of the channels between two of 1x1, beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: Norm, bottleneck: bool) -> None:
        super().__init__()
        inner = outputs // 4
        layers = [(inputs, outputs, 3, stride), (outputs, outputs, 3, 1)]  # channels in and out, kernel, stride
        if bottleneck:
            layers = [(inputs, inner, 1, 1), (inner, inner, 3, stride), (inner, outputs, 1, 1)]
        self.depth = len(layers)
        for number, (before, after, side, step) in enumerate(layers, start=1):
            self.add_module(f"conv{number}", nn.Conv2d(before, after, side, stride=step, padding=side // 2))
            self.add_module(f"norm{number}", norm(after))
        self.downsample = nn.Sequential()
        if stride > 1:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride=stride), norm(outputs))

    def forward(self, state: Features) -> Tensor:
        """Features (B, outputs, H / stride, W / stride)."""
        change = state
        for number in range(1, self.depth + 1):
            change = self.get_submodule(f"norm{number}")(self.get_submodule(f"conv{number}")(change)).relu()
        shortcut: Tensor = self.downsample(state)
        return (shortcut + change).relu()


class RaftEncoder(nn.Module):
    """Features of images at an eighth of their resolution; `stages` are the channels of its three stages."""

    def __init__(self, stages: tuple[int, int, int], outputs: int, norm: Norm, bottleneck: bool) -> None:
        super().__init__()

        def stage(inputs: int, channels: int, stride: int) -> nn.Module:
            first = ResidualUnit(inputs, channels, stride, norm, bottleneck)
            return nn.Sequential(first, ResidualUnit(channels, channels, 1, norm, bottleneck))

        first, second, third = stages
        self.conv1 = nn.Conv2d(3, first, 7, stride=2, padding=3)
        self.norm1 = norm(first)
        self.layer1 = stage(first, first, 1)
        self.layer2 = stage(first, second, 2)
        self.layer3 = stage(second, third, 2)
        self.conv2 = nn.Conv2d(third, outputs, 1)

    def forward(self, images: Images) -> Features:
        """Features (B, outputs, H / 8, W / 8) of images (B, 3, H, W) in [-1, 1], H and W multiples of 8."""
        state = self.norm1(self.conv1(images)).relu()
        features: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(state))))
        return features
