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


def instance_norm(channels: int) -> nn.Module:
    """Each channel of each sample to mean 0 and variance 1; no parameters."""
    return nn.InstanceNorm2d(channels)


def batch_norm(channels: int) -> nn.Module:
    """With the statistics that come with the weights."""
    return nn.BatchNorm2d(channels)


def no_norm(_: int) -> nn.Module:
    """The identity."""
    return nn.Sequential()


class ResidualUnit(nn.Module):
    """Two 3x3 convolutions beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: Norm) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.norm1, self.norm2 = norm(outputs), norm(outputs)
        self.downsample = _shortcut(inputs, outputs, stride, norm)

    def forward(self, state: Features) -> Tensor:
        """Features (B, outputs, H / stride, W / stride)."""
        change = self.norm1(self.conv1(state)).relu()
        change = self.norm2(self.conv2(change)).relu()
        shortcut: Tensor = self.downsample(state)
        return (shortcut + change).relu()


class BottleneckUnit(nn.Module):
    """A 3x3 convolution of a quarter of the channels between two 1x1 convolutions, beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: Norm) -> None:
        super().__init__()
        inner = outputs // 4
        self.conv1 = nn.Conv2d(inputs, inner, 1)
        self.conv2 = nn.Conv2d(inner, inner, 3, stride=stride, padding=1)
        self.conv3 = nn.Conv2d(inner, outputs, 1)
        self.norm1, self.norm2, self.norm3 = norm(inner), norm(inner), norm(outputs)
        self.downsample = _shortcut(inputs, outputs, stride, norm)

    def forward(self, state: Features) -> Tensor:
        """Features (B, outputs, H / stride, W / stride)."""
        change = self.norm1(self.conv1(state)).relu()
        change = self.norm2(self.conv2(change)).relu()
        change = self.norm3(self.conv3(change)).relu()
        shortcut: Tensor = self.downsample(state)
        return (shortcut + change).relu()


def _shortcut(inputs: int, outputs: int, stride: int, norm: Norm) -> nn.Module:
    if stride == 1:
        return nn.Sequential()
    return nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride=stride), norm(outputs))


class RaftEncoder(nn.Module):
    """Features of images at an eighth of their resolution.

    `stages` are the channels of its three stages.
    """

    def __init__(
        self,
        stages: tuple[int, int, int],
        outputs: int,
        unit: type[ResidualUnit] | type[BottleneckUnit],
        norm: Norm,
    ) -> None:
        super().__init__()
        first, second, third = stages
        self.conv1 = nn.Conv2d(3, first, 7, stride=2, padding=3)
        self.norm1 = norm(first)
        self.layer1 = nn.Sequential(unit(first, first, 1, norm), unit(first, first, 1, norm))
        self.layer2 = nn.Sequential(unit(first, second, 2, norm), unit(second, second, 1, norm))
        self.layer3 = nn.Sequential(unit(second, third, 2, norm), unit(third, third, 1, norm))
        self.conv2 = nn.Conv2d(third, outputs, 1)

    def forward(self, images: Images) -> Features:
        """Features (B, outputs, H / 8, W / 8) of images (B, 3, H, W) in [-1, 1], H and W multiples of 8."""
        state = self.norm1(self.conv1(images)).relu()
        features: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(state))))
        return features
