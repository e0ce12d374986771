"""The network as a CUDA graph: launching its kernels one by one takes longer than they do.

In use (`Recorder`), registration included, one launch a pair stands for a thousand. In training
(`GraphedNetwork`), `torch.cuda.make_graphed_callables` records forward and backward pass for one shape of images, and
one launch a step stands for five thousand. That recording owns the memory of what it keeps for the backward pass, so
between two backward passes it may be called only once.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from gelflow.arrays import Flow, Images
from gelflow.models.gelflow import GelFlow

Run = Callable[..., tuple[Tensor, ...]]

MOST = 4
"""Recordings that a `Recorder` remembers: flow and, for the closure, flow backward, at two shapes."""


class Recorder:
    """Calls functions of CUDA tensors, and records what they do when shapes come a second time, to replay it.

    `MOST` calls are remembered, told apart by function, shapes, and arguments that are no tensors. Networks have to be
    in evaluation mode; their weights may change in place, not move. Without gradient; a call whose tensors are not all
    on a CUDA device, and one with ever other shapes, is made as it is.
    """

    def __init__(self) -> None:
        self._recordings: dict[tuple[Any, ...], Run | None] = {}

    @torch.no_grad()
    def __call__(self, function: Run, *arguments: Any) -> tuple[Tensor, ...]:
        """What the function, which waits for nothing and returns tensors, gives for these arguments."""
        if not all(each.is_cuda for each in arguments if isinstance(each, Tensor)):
            return function(*arguments)
        key = (function, *(each.shape if isinstance(each, Tensor) else each for each in arguments))
        if key not in self._recordings:
            if len(self._recordings) == MOST:
                self._recordings.clear()
            self._recordings[key] = None
            return function(*arguments)
        replay = self._recordings[key] = self._recordings[key] or _replay(function, arguments)
        return replay(*arguments)


def _replay(function: Run, arguments: Sequence[Any]) -> Run:
    """What replays a call with other tensors; the function itself, with a warning, where a device cannot record it."""
    kept = [each.clone() if isinstance(each, Tensor) else each for each in arguments]
    tensors = [each for each in kept if isinstance(each, Tensor)]
    here, aside = torch.cuda.current_stream(tensors[0].device), torch.cuda.Stream(tensors[0].device)
    # Once more on a stream of its own, as recording asks for, so that libraries have chosen their kernels.
    aside.wait_stream(here)
    with torch.cuda.stream(aside):
        function(*kept)
    here.wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    try:
        with torch.cuda.graph(graph):
            results = function(*kept)
    except RuntimeError as error:
        torch.cuda.set_stream(here)  # the recording's own stream is left only where it succeeds
        reason = str(error).partition("\n")[0]
        warnings.warn(f"each pair takes longer, because no CUDA graph could be recorded: {reason}", stacklevel=3)
        return function

    def replay(*given: Any) -> tuple[Tensor, ...]:
        for old, new in zip(tensors, (each for each in given if isinstance(each, Tensor)), strict=True):
            old.copy_(new)
        graph.replay()
        return tuple(each.clone() for each in results)

    return replay


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
