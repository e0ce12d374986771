"""The interface of everything that estimates flow, whose arrays are (H, W, C), and torch's tensors, (1, C, H, W)."""

import time
from typing import Any, Protocol

import numpy as np
import torch

from gelflow.arrays import Estimate, FlowArray, ImageArray, MapArray
from gelflow.fast.certainty import doubted
from gelflow.methods.fast import Fast
from gelflow.methods.name import MethodName
from gelflow.models.working_size import sized_sigma, working_sizes


class Method(Protocol):
    """Estimates the flow from image 1 to image 2: ``I1(x) = I2(x + flow(x))``."""

    @property
    def name(self) -> MethodName:
        """Name in tables."""

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """Flow (H, W, 2) float32 in px of two images (H, W, 3) float32 in [0, 1].

        Raises:
            InputError: The images differ in shape, are too small, or hold values that are not finite.
        """


def as_tensor(image: ImageArray, device: str) -> Any:
    """An image or flow (H, W, C) float32 as a tensor (1, C, H, W) on a device."""
    return torch.from_numpy(np.ascontiguousarray(image)).to(device).movedim(-1, 0).contiguous()[None]


def as_array(flow: Any) -> FlowArray:
    """The first flow of a tensor (B, 2, H, W) as (H, W, 2) float32; waits for the device."""
    array: FlowArray = flow[0].permute(1, 2, 0).float().contiguous().cpu().numpy()
    return array


def uncertainty(flow: FlowArray, image1: ImageArray, image2: ImageArray, device: str) -> tuple[MapArray, MapArray]:
    """Sigma in px and the probability to be seen in image 2, (H, W) float32: `gelflow.models.uncertainty`.

    Of the sizes at which large images are worked on, the one with the least mean of sigma counts. Where the flow may
    have taken dots for the next ones (`gelflow.fast.certainty`), nothing is known.
    """
    given, first, second = (as_tensor(array, device) for array in (flow, image1, image2))
    maps = (sized_sigma(given, first, second, size) for size in working_sizes(*image1.shape[:2]))
    sigma, visible = min(maps, key=lambda each: float(each[0].mean()))
    return doubted(flow, sigma[0, 0].cpu().numpy(), image1, image2), visible[0, 0].cpu().numpy()


def estimated(method: Method, image1: ImageArray, image2: ImageArray) -> tuple[Estimate, float]:
    """A method's flow with its uncertainty, and the time in s; of all but `Fast`, whose own it is, the flow's alone."""
    started = time.perf_counter()
    if isinstance(method, Fast):
        return method.estimate(image1, image2), time.perf_counter() - started
    flow = method.flow(image1, image2)
    seconds = time.perf_counter() - started
    return Estimate(flow, *uncertainty(flow, image1, image2, getattr(method, "device", "cpu"))), seconds
