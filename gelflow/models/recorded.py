"""A network in use, registration included, as a CUDA graph: one launch a pair in place of a thousand.

Launching them takes longer than the kernels do.
"""

import torch
from torch import Tensor

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
