"""The parts of the GelFlow network: encoder, flow estimator and its context, local flow fusion, refinement head."""

import math
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gelflow.arrays import Features, Flow, Images
from gelflow.ops.correlation import local_correlation
from gelflow.ops.warp import warp

SLOPE = 0.1
"""Negative slope of every leaky ReLU, as in PWC-Net."""
CHANNELS = (16, 32, 64, 96, 128, 192, 256)
"""Feature channels at s = 1 .. 7."""
CONTEXT_CHANNELS = 32
"""Channels of the estimator's last features."""
CONTEXT_LAYERS = ((128, 1), (128, 2), (128, 4), (96, 8), (64, 16), (32, 1))
"""Channels and dilation of each layer of the context network."""
REFINEMENT_RADIUS, REFINEMENT_CHANNELS, REFINEMENTS = 3, 48, 3
"""Of the refinement head: search range, px of its scale; channels within; iterations."""


def convolution(inputs: int, outputs: int, *, side: int = 3, stride: int = 1, dilation: int = 1) -> nn.Module:
    """A convolution of an odd side, padded to keep the size (at stride 2: half of it, rounded up), with its leaky ReLU.

    Weights start normal with the variance that keeps the signal's (He et al. 2015, fan-in), biases at zero.
    """
    layer = nn.Conv2d(inputs, outputs, side, stride=stride, padding=side // 2 * dilation, dilation=dilation)
    nn.init.kaiming_normal_(layer.weight, a=SLOPE)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return Convolution(layer, nn.LeakyReLU(SLOPE, inplace=True))


class Convolution(nn.Sequential):
    """A convolution and its leaky ReLU."""

    def forward(self, features: Features) -> Features:
        layer: Any = self[0]
        if not features.is_cuda or torch.is_grad_enabled() or torch.is_autocast_enabled("cuda"):
            return super().forward(features)
        from gelflow.models import fused_network as fused

        found = F.conv2d(features, layer.weight, None, layer.stride, layer.padding, layer.dilation)
        return fused.add_bias(found, layer.bias, SLOPE)


def flow_head(inputs: int) -> nn.Conv2d:
    """A 3x3 convolution to two channels whose answer starts a hundred times smaller than its input.

    A fresh network then predicts next to no motion at every scale, instead of a random flow that warps the features of
    all finer scales to the wrong place.
    """
    layer = nn.Conv2d(inputs, 2, 3, padding=1)
    nn.init.normal_(layer.weight, std=0.01 / math.sqrt(9 * inputs))
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


class Encoder(nn.Module):
    """Feature pyramid of PWC-Net (Sun et al. 2018) at s = 1 .. levels-1: a strided and a plain convolution per scale.

    Scale s has ceil(H / 2^s) x ceil(W / 2^s) pixels.
    """

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


class Estimator(nn.Module):
    """PWC-Net's estimator in ARFlow's reduced form: five densely connected convolutions and a flow head.

    The evidence is the cost volume, the first image's projected features and the flow so far.
    """

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
    """Refines the flow over a wide area by dilated convolutions on the estimator's context and the coarse flow."""

    def __init__(self) -> None:
        super().__init__()
        inputs, layers = CONTEXT_CHANNELS + 2, []
        for outputs, dilation in CONTEXT_LAYERS:
            layers.append(convolution(inputs, outputs, dilation=dilation))
            inputs = outputs
        self.layers = nn.Sequential(*layers, flow_head(inputs))

    def forward(self, context: Features, flow: Flow) -> Tensor:
        """Correction of the flow, (B, 2, H, W) in px of this scale."""
        correction: Tensor = self.layers(torch.cat([context, flow.to(context.dtype)], dim=1))
        return correction


class LocalFlowFusion(nn.Module):
    """Local flow fusion (paper, section 3.2): a flow smoothed where neighbouring context features agree.

    ``V'(x) = sum_d w(x, d) V(x + d)``,  ``w(x, .) = softmax_d( k <C(x), C(x + d)> )`` over the neighbours d of a 3x3
    window that lie inside the image. The paper has k = 1 (`scale` = "none"); "inverse_sqrt" is k = 1/sqrt(number of
    channels), as in scaled dot-product attention, because in a new network with k = 1 the weight of the centre tends to
    one as features grow. Neighbours beyond the border get no weight, so a constant flow stays exactly as it is, and
    every fused flow lies between the flows that it was made from. There are no parameters.
    """

    def __init__(self, scale: str) -> None:
        super().__init__()
        self.scale = scale

    def weights(self, context: Features) -> Tensor:
        """Weight of each neighbour, (B, 9, H, W), row by row; at every pixel they sum to one."""
        channels, height, width = context.shape[1:]
        share = math.sqrt(channels) if self.scale == "inverse_sqrt" else channels
        similarity = share * local_correlation(context, context, 1)  # which is a mean over C
        beyond = F.unfold(context.new_ones(1, 1, height, width), 3, padding=1).view(1, 9, height, width) == 0
        return torch.softmax(similarity.masked_fill(beyond, -torch.inf), dim=1)

    def forward(self, flow: Flow, context: Features) -> Flow:
        """Fuses a flow (B, 2, H, W) by the context (B, C, H, W)."""
        batch, _, height, width = flow.shape
        if flow.is_cuda and not torch.is_grad_enabled():
            from gelflow.models import fused_network as fused

            return fused.locally_fused(
                flow, context, 1 / math.sqrt(context.shape[1]) if self.scale == "inverse_sqrt" else 1.0
            )
        neighbours = F.unfold(flow, 3, padding=1).view(batch, 2, 9, height, width)
        return (neighbours * self.weights(context).unsqueeze(1)).sum(dim=2)


class RefinementHead(nn.Module):
    """Corrects the decoded flow at half of the resolution by what local correlation finds there.

    Each iteration warps the second image's fine features by the flow so far, correlates, and adds a correction computed
    by three convolutions that all iterations share. It is not part of the paper, whose finest flow is an enlargement of
    a quarter of the resolution.
    """

    def __init__(self) -> None:
        super().__init__()
        inputs = (2 * REFINEMENT_RADIUS + 1) ** 2 + CHANNELS[0] + 2
        self.layers = nn.Sequential(
            convolution(inputs, REFINEMENT_CHANNELS), convolution(REFINEMENT_CHANNELS, REFINEMENT_CHANNELS, dilation=2)
        )
        self.head = flow_head(REFINEMENT_CHANNELS)

    def forward(self, flow: Flow, encoded: Features) -> Flow:
        """Corrects a flow.

        Flow and features, those of both images (2 B, C, H, W), are of the scale s = 1.
        """
        # Unit length: a correlation near one says "here", whatever the contrast.
        first, second = F.normalize(encoded.float(), dim=1).split(flow.shape[0])
        none = first.new_zeros(len(first))
        for _ in range(REFINEMENTS):
            if flow.is_cuda and not torch.is_grad_enabled():
                from gelflow.models import fused_network as fused

                both = fused.side_by_side(first, second, flow)
                costs = fused.costs(both, none, none + 1 / first.shape[1], REFINEMENT_RADIUS, SLOPE)
            else:
                costs = local_correlation(first.shape[1] * first, warp(second, flow), REFINEMENT_RADIUS)
                costs = F.leaky_relu(costs, SLOPE, inplace=not torch.is_grad_enabled())
            evidence = torch.cat([part.to(encoded.dtype) for part in (costs, first, flow)], dim=1)
            flow = flow + self.head(self.layers(evidence)).float()
        return flow
