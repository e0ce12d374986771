"""A network in use as a CUDA graph: one launch a pair in place of some thousand, which take longer than the kernels."""

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.models.gelflow import GelFlow


class RecordedNetwork:
    """A network whose pass over CUDA images is recorded when a shape comes a second time, and replayed from then on.

    Without gradient; on a CPU, and for images of ever other shapes, the network as it is. Its weights may change in
    place, not move.

    Args:
        model: The network, in evaluation mode when it is called.
    """

    def __init__(self, model: GelFlow) -> None:
        self.model = model
        self._shape: torch.Size | None = None
        self._graph: torch.cuda.CUDAGraph | None = None
        self._images: list[Tensor] = []
        self._flows: list[Tensor] = []

    @torch.no_grad()
    def __call__(self, image1: Images, image2: Images) -> list[Flow]:
        """As `GelFlow.forward`."""
        if not image1.is_cuda or image1.shape != image2.shape or image1.shape != self._shape:
            self._shape, self._graph = image1.shape, None
            flows: list[Tensor] = self.model(image1, image2)
            return flows
        graph = self._graph or self._record(image1, image2)
        for kept, new in zip(self._images, (image1, image2), strict=True):
            kept.copy_(new)
        graph.replay()
        return [flow.clone() for flow in self._flows]

    def _record(self, image1: Images, image2: Images) -> torch.cuda.CUDAGraph:
        self._images = [image1.clone(), image2.clone()]
        # Once more on a stream of its own, as recording asks for, so that libraries have chosen their kernels.
        aside = torch.cuda.Stream(image1.device)
        aside.wait_stream(torch.cuda.current_stream(image1.device))
        with torch.cuda.stream(aside):
            self.model(*self._images)
        torch.cuda.current_stream(image1.device).wait_stream(aside)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._flows = self.model(*self._images)
        return self._graph
