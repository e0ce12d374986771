"""The one convolution that all parts of the network are built from."""

import math

from torch import nn

SLOPE = 0.1
"""Negative slope of every leaky ReLU, as in PWC-Net."""


def convolution(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> nn.Module:
    """A 3x3 convolution, padded to keep the size (at stride 2: half of it, rounded up), with its leaky ReLU.

    Weights start normal with the variance that keeps the signal's (He et al. 2015, fan-in), biases at zero.
    """
    layer = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=dilation, dilation=dilation)
    nn.init.kaiming_normal_(layer.weight, a=SLOPE)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return nn.Sequential(layer, nn.LeakyReLU(SLOPE))


def flow_head(inputs: int) -> nn.Conv2d:
    """A 3x3 convolution to two channels whose answer starts a hundred times smaller than its input.

    A fresh network then predicts next to no motion at every scale, instead of a random flow that warps the features of
    all finer scales to the wrong place.
    """
    layer = nn.Conv2d(inputs, 2, 3, padding=1)
    nn.init.normal_(layer.weight, std=0.01 / math.sqrt(9 * inputs))
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer
