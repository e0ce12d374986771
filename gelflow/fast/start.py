"""Starts of a registration: OpenCV's DIS with small and large patches, and the one of them that fits the place.

Small patches lose coarse patterns, large ones detail, and DIS medium, whose flow is smoothed, takes dots for their
neighbours where they are far apart. Each start is registered under the widest window. In a window that spans several
marks, so that one mark's neighbour does not stand for it, the start with the least residual is taken. DIS medium takes
longest and is tried only where the others leave more than noise.

Where marks move by half their distance or more, all may take dots for the next ones. At the edge of what was taken,
images then differ. If they do on more than `MOST_TORN` of the picture, a network is asked, which takes three times as
long, and of both flows the one that tears less is kept.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import torch

from gelflow.arrays import FlowArray, Grey8, ImageArray
from gelflow.fast.registration import CONFIG, STAGES, Prepared, register, resized, unexplained
from gelflow.models import GelFlow
from gelflow.models.estimate import estimate_flow
from gelflow.models.weights import load_weights, weights_file

Network = Callable[[ImageArray, ImageArray], FlowArray | None]
"""Gives the flow between two images of one size, as `gelflow.methods.method.Method.flow`; None: it will come later."""
CHOICE_WINDOW_PX = 25.0
"""Standard deviation of the window in which starts are compared."""
MIN_GAIN = 0.95
"""A start replaces an earlier one if its residual is below this share of the earlier one's."""
MOST_UNEXPLAINED = 1e-3
"""Share of the picture that may be left with more than noise before another start is tried."""


TORN, MOST_TORN, UNRELATED = 0.3, 0.01, 0.9
"""Share of the residual of unrelated images above which a flow tears the picture; shares of the picture that are torn
between which a network is asked. Beyond the last, one image has nothing to do with the other."""


def fresh_start(
    first: Prepared, second: Prepared, starts: Sequence[FlowArray] = (), network: Network | None = None
) -> FlowArray:
    """The flow to go on from after the first stage; `starts` are compared with DIS, and preferred to it.

    The network is that of the shipped weights, unless another one is given.
    """
    widest = STAGES[:1]
    first_starts = [*starts, dis("large", first.grey, second.grey), dis("ultrafast", first.grey, second.grey)]
    flow = best_of([register(start, first, second, widest) for start in first_starts], first, second)
    square, _ = unexplained(flow, first, second, CONFIG.windows_px[0])
    if (square > (2 * CONFIG.noise) ** 2).mean() > MOST_UNEXPLAINED:
        medium = register(dis("medium", first.grey, second.grey), first, second, widest)
        flow = best_of([flow, medium], first, second)
    left = torn(flow, first, second)
    if MOST_TORN < left < UNRELATED and (found := (network or shipped)(first.whole, second.whole)) is not None:
        asked = register(found, first, second, widest)
        flow = asked if torn(asked, first, second) < left else flow
    return flow


def torn(flow: FlowArray, first: Prepared, second: Prepared) -> float:
    """Share of the picture in which a flow leaves more than noise and `TORN`."""
    square, share = unexplained(flow, first, second, CONFIG.windows_px[0])
    return float(((share > TORN) & (square > CONFIG.noise**2)).mean())


def shipped(image1: ImageArray, image2: ImageArray) -> FlowArray:
    """The flow of the shipped network, without its registration; it is loaded at the first call."""
    one, other = (torch.from_numpy(image).movedim(-1, 0).contiguous()[None] for image in (image1, image2))
    return np.ascontiguousarray(estimate_flow(_shipped_network(), one, other)[0].movedim(0, -1).numpy())


@functools.cache
def _shipped_network() -> GelFlow:
    network = load_weights(weights_file(None))
    network.config = network.config.model_copy(update={"registration": None})
    return network


def best_of(flows: Sequence[FlowArray], first: Prepared, second: Prepared) -> FlowArray:
    """At each place the flow with the least residual of those on one grid; an earlier one where they hardly differ."""
    best = flows[0]
    least = MIN_GAIN * unexplained(best, first, second, CHOICE_WINDOW_PX)[0]
    for flow in flows[1:]:
        square, _ = unexplained(flow, first, second, CHOICE_WINDOW_PX)
        better = resized((square < least).astype(np.float32), flow.shape[:2])[..., None]
        best, least = best + better * (flow - best), np.minimum(least, square)
    return best


def dis(kind: str, grey1: Grey8, grey2: Grey8) -> FlowArray:
    """DIS with one of OpenCV's presets, or "large": ultrafast with patches of 16 px, four px apart."""
    preset = "ULTRAFAST" if kind == "large" else kind.upper()
    method: Any = cv2.DISOpticalFlow.create(getattr(cv2, f"DISOPTICAL_FLOW_PRESET_{preset}"))
    if kind == "large":
        method.setPatchSize(16)
        method.setPatchStride(4)
        method.setGradientDescentIterations(16)
    return np.asarray(method.calc(grey1, grey2, None))
