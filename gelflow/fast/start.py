"""Starts of a registration: OpenCV's DIS with small and large patches, and the one of them that fits the place.

Small patches lose coarse patterns, large ones detail, and DIS medium, whose flow is smoothed, takes dots for their
neighbours where they are far apart. Each start is registered under the widest window. In a window that spans several
marks, so that one mark's neighbour does not stand for it, the start with the least residual is taken. DIS medium takes
longest and is tried only where the others leave more than noise.
"""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from gelflow.arrays import FlowArray, Grey8
from gelflow.fast.registration import CONFIG, STAGES, Prepared, register, resized, unexplained

CHOICE_WINDOW_PX = 25.0
"""Standard deviation of the window in which starts are compared."""
MIN_GAIN = 0.95
"""A start replaces an earlier one if its residual is below this share of the earlier one's."""
MOST_UNEXPLAINED = 1e-3
"""Share of the picture that may be left with more than noise before another start is tried."""


def fresh_start(first: Prepared, second: Prepared, starts: Sequence[FlowArray] = ()) -> FlowArray:
    """The flow to go on from after the first stage; `starts` are compared with DIS, and preferred to it."""
    widest = STAGES[:1]
    first_starts = [*starts, dis("large", first.grey, second.grey), dis("ultrafast", first.grey, second.grey)]
    flow = best_of([register(start, first, second, widest) for start in first_starts], first, second)
    square, _ = unexplained(flow, first, second, CONFIG.windows_px[0])
    if (square > (2 * CONFIG.noise) ** 2).mean() > MOST_UNEXPLAINED:
        medium = register(dis("medium", first.grey, second.grey), first, second, widest)
        flow = best_of([flow, medium], first, second)
    return flow


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
