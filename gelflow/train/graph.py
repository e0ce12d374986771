"""The network as a CUDA graph: one launch a step in place of some five thousand, most of them shorter than a launch.

`torch.cuda.make_graphed_callables` records forward and backward pass for one shape of images. The recording owns the
memory of what it keeps for the backward pass, so between two backward passes it may be called only once.
"""

from typing import Any

import torch
from torch import Tensor, nn

from gelflow.arrays import Flow, Images
from gelflow.models import GelFlow


class GraphedNetwork:
    """A network in training whose passes over CUDA batches are replayed from a graph.

    Recorded at the first call, for its shape; batches of another shape take the network as it is.
    """

    def __init__(self, model: GelFlow) -> None:
        self.model = model
        self._graphed: Any = None
        self._shape: torch.Size | None = None

    def __call__(self, image1: Images, image2: Images) -> list[Flow]:
        """As `GelFlow.forward`. Not to be called again before the backward pass."""
        if self._graphed is None:
            self._shape = image1.shape
            # Recording refuses autocast's cache of converted weights, which would keep the weights of the first step.
            reduced = torch.is_autocast_enabled("cuda")
            with torch.autocast("cuda", torch.get_autocast_dtype("cuda"), enabled=reduced, cache_enabled=False):
                examples = (torch.rand_like(image1), torch.rand_like(image2))
                self._graphed = torch.cuda.make_graphed_callables(_Pass(self.model), examples)
        if image1.shape != self._shape:
            flows: list[Tensor] = self.model(image1, image2)
            return flows
        return list(self._graphed(image1, image2))


class _Pass(nn.Module):
    """The network's pass in a module of its own: recording replaces a module's `forward`, which others still need."""

    def __init__(self, model: GelFlow) -> None:
        super().__init__()
        self.model = model

    def forward(self, image1: Images, image2: Images) -> tuple[Flow, ...]:
        return tuple(self.model(image1, image2))
