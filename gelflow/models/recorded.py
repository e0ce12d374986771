"""The network as a CUDA graph: launching its kernels one by one takes longer than they do.

In use (`RecordedNetwork`), registration included, one launch a pair stands for a thousand. In training
(`GraphedNetwork`), `torch.cuda.make_graphed_callables` records forward and backward pass for one shape of images, and
one launch a step stands for five thousand. That recording owns the memory of what it keeps for the backward pass, so
between two backward passes it may be called only once.
"""

from typing import Any

import torch
from torch import Tensor, nn

from gelflow.arrays import Flow, Images
from gelflow.models.gelflow import GelFlow


class RecordedNetwork:
    """A network whose pass over CUDA images is recorded when a shape comes a second time, and replayed from then on.

    The network has to be in evaluation mode when it is called.

    Without gradient; on a CPU, and for images of ever other shapes, the network as it is. Its weights may change in
    place, not move.
    """

    def __init__(self, model: GelFlow) -> None:
        self.model = model
        self._shape: torch.Size | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._images: list[Tensor] = []
        self._flow = torch.empty(0)

    @torch.no_grad()
    def __call__(self, image1: Images, image2: Images) -> Flow:
        """Estimates the flow; arguments and exceptions as for `GelFlow.flow`."""
        if not image1.is_cuda or image1.shape != image2.shape or image1.shape != self._shape:
            self._shape, self._graph = image1.shape, None
            return self.model.flow(image1, image2)
        graph = self._graph or self._record(image1, image2)
        for kept, new in zip(self._images, (image1, image2), strict=True):
            kept.copy_(new)
        graph.replay()
        return self._flow.clone()

    def _record(self, image1: Images, image2: Images) -> torch.cuda.CUDAGraph:
        self._images = [image1.clone(), image2.clone()]
        # Once more on a stream of its own, as recording asks for, so that libraries have chosen their kernels.
        aside = torch.cuda.Stream(image1.device)
        aside.wait_stream(torch.cuda.current_stream(image1.device))
        with torch.cuda.stream(aside):
            self.model.flow(*self._images)
        torch.cuda.current_stream(image1.device).wait_stream(aside)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._flow = self.model.flow(*self._images)
        return self._graph


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
