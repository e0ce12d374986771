"""The network as a CUDA graph: launching its kernels one by one takes longer than they do.

In use (`RecordedNetwork`), registration included, one launch a pair stands for a thousand. In training
(`GraphedNetwork`), `torch.cuda.make_graphed_callables` records forward and backward pass for one shape of images, and
one launch a step stands for five thousand. That recording owns the memory of what it keeps for the backward pass, so
between two backward passes it may be called only once.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from gelflow.arrays import Flow, Images
from gelflow.models.gelflow import GelFlow


class RecordedNetwork:
    """A network whose pass over CUDA images is recorded when a shape comes a second time, and replayed from then on.

    Two shapes are remembered, those of `gelflow.models.working_size`. The network has to be in evaluation mode when it
    is called.

    Without gradient; on a CPU, and for images of ever other shapes, the network as it is. Its weights may change in
    place, not move.
    """

    def __init__(self, model: GelFlow) -> None:
        self.model = model
        self._recordings: dict[torch.Size, _Recording | None] = {}

    @torch.no_grad()
    def __call__(self, image1: Images, image2: Images) -> Flow:
        """Estimates the flow; arguments and exceptions as for `GelFlow.flow`."""
        shape = image1.shape
        if not image1.is_cuda or shape != image2.shape:
            return self.model.flow(image1, image2)
        if shape not in self._recordings:
            if len(self._recordings) == 2:
                self._recordings.clear()
            self._recordings[shape] = None
            return self.model.flow(image1, image2)
        recording = self._recordings[shape] or self._record(image1, image2)
        for kept, new in zip(recording.images, (image1, image2), strict=True):
            kept.copy_(new)
        recording.graph.replay()
        return recording.flow.clone()

    def _record(self, image1: Images, image2: Images) -> "_Recording":
        images = [image1.clone(), image2.clone()]
        # Once more on a stream of its own, as recording asks for, so that libraries have chosen their kernels.
        aside = torch.cuda.Stream(image1.device)
        aside.wait_stream(torch.cuda.current_stream(image1.device))
        with torch.cuda.stream(aside):
            self.model.flow(*images)
        torch.cuda.current_stream(image1.device).wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            flow = self.model.flow(*images)
        self._recordings[image1.shape] = recording = _Recording(graph, images, flow)
        return recording


class _Recording(NamedTuple):
    graph: torch.cuda.CUDAGraph
    images: list[Tensor]
    flow: Flow


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
