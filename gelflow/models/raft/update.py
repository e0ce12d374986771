"""RAFT's recurrent update (Teed and Deng 2020, section 3.3): what it found around the present flow, put into a hidden
state by a convolutional gated recurrent unit, and a change of the flow from that state.

Names of submodules are those of the published weights, see `gelflow.models.raft.weights`.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from gelflow.arrays import Features, Flow


class Sizes(NamedTuple):
    """Channels of the two published networks; numbers of channels unless stated otherwise.

    Attributes:
        stages, features: Of the feature encoder; those of the context encoder's stages are the same.
        hidden, context: Of the hidden state and of the context that accompanies it.
        radius: Of the correlation lookup, px.
        correlation, motion: Layers of the motion encoder on correlations and on the flow.
        evidence: Result of the motion encoder, without the flow itself.
        head: Of the flow head.
    """

    stages: tuple[int, int, int]
    features: int
    hidden: int
    context: int
    radius: int
    correlation: tuple[int, ...]
    motion: tuple[int, int]
    evidence: int
    head: int


SMALL = Sizes((32, 64, 96), 128, 96, 64, 3, (96,), (64, 32), 80, 128)
LARGE = Sizes((64, 96, 128), 256, 128, 128, 4, (256, 192), (128, 64), 126, 256)


class MotionEncoder(nn.Module):
    """Evidence on the motion from the correlations that were looked up and from the present flow."""

    def __init__(self, sizes: Sizes, costs: int) -> None:
        super().__init__()
        first, *second = sizes.correlation
        self.convc1 = nn.Conv2d(costs, first, 1)
        self.convc2 = nn.Conv2d(first, second[0], 3, padding=1) if second else None
        self.convf1 = nn.Conv2d(2, sizes.motion[0], 7, padding=3)
        self.convf2 = nn.Conv2d(sizes.motion[0], sizes.motion[1], 3, padding=1)
        self.conv = nn.Conv2d(sizes.correlation[-1] + sizes.motion[1], sizes.evidence, 3, padding=1)

    def forward(self, flow: Flow, costs: Features) -> Tensor:
        """Evidence, the flow itself as its last two channels, (B, evidence + 2, H, W)."""
        match = self.convc1(costs).relu()
        if self.convc2 is not None:
            match = self.convc2(match).relu()
        motion = self.convf2(self.convf1(flow).relu()).relu()
        both = self.conv(torch.cat([match, motion], dim=1)).relu()
        return torch.cat([both, flow], dim=1)


class GatedUnit(nn.Module):
    """Convolutional gated recurrent unit: 3x3 convolutions (small network), or a row of five pixels, then a column."""

    def __init__(self, hidden: int, inputs: int, *, separable: bool) -> None:
        super().__init__()
        self.passes = {"1": (1, 5), "2": (5, 1)} if separable else {"": (3, 3)}
        for suffix, size in self.passes.items():
            for gate in "zrq":
                layer = nn.Conv2d(hidden + inputs, hidden, size, padding=(size[0] // 2, size[1] // 2))
                self.add_module(f"conv{gate}{suffix}", layer)

    def forward(self, hidden: Features, inputs: Features) -> Tensor:
        for suffix in self.passes:
            update, reset, candidate = (self.get_submodule(f"conv{gate}{suffix}") for gate in "zrq")
            both = torch.cat([hidden, inputs], dim=1)
            share = torch.sigmoid(update(both))
            remembered = torch.sigmoid(reset(both)) * hidden
            hidden = (1 - share) * hidden + share * torch.tanh(candidate(torch.cat([remembered, inputs], dim=1)))
        return hidden


class FlowHead(nn.Module):
    def __init__(self, inputs: int, inner: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, inner, 3, padding=1)
        self.conv2 = nn.Conv2d(inner, 2, 3, padding=1)

    def forward(self, hidden: Features) -> Tensor:
        """Change of the flow, (B, 2, H, W) px."""
        change: Tensor = self.conv2(self.conv1(hidden).relu())
        return change


class UpdateBlock(nn.Module):
    """One iteration: evidence, hidden state, change of the flow; in the large network also upsampling weights."""

    def __init__(self, sizes: Sizes, costs: int, *, large: bool) -> None:
        super().__init__()
        inputs = sizes.context + sizes.evidence + 2
        self.encoder = MotionEncoder(sizes, costs)
        self.gru = GatedUnit(sizes.hidden, inputs, separable=large)
        self.flow_head = FlowHead(sizes.hidden, sizes.head)
        self.mask = None
        if large:
            self.mask = nn.Sequential(nn.Conv2d(sizes.hidden, 256, 3, padding=1), nn.ReLU(), nn.Conv2d(256, 9 * 64, 1))

    def forward(
        self, hidden: Features, context: Features, costs: Features, flow: Flow
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Next hidden state, change of the flow, and upsampling weights (B, 9 64, H, W) before their softmax or None.

        The weights are divided by 4, as the published ones were trained.
        """
        evidence = self.encoder(flow, costs)
        hidden = self.gru(hidden, torch.cat([context, evidence], dim=1))
        weights = None if self.mask is None else 0.25 * self.mask(hidden)
        return hidden, self.flow_head(hidden), weights
