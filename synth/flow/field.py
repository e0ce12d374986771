"""The record of an exact optical flow between two states of a gel."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FlowArray = NDArray[np.float32]


@dataclass(frozen=True)
class FlowField:
    """Exact flow between image 1 and image 2: `I1(x) = I2(x + forward(x))`, `I2(x) = I1(x + backward(x))`.

    Attributes:
        forward: (H, W, 2) float32 px, U (+x, right) and V (+y, down) at pixel centres; NaN where the pixel sees no gel.
        forward_visible: (H, W) float32; 1 where the pixel's material point is seen in image 2, else 0.
        backward, backward_visible: the same with the images exchanged; None when not asked for.
        extras: optional channels by their EXR name, e.g. "depth1.Z", each (H, W) float32 (NaN where no gel is seen).
    """

    forward: FlowArray
    forward_visible: FlowArray
    backward: FlowArray | None = None
    backward_visible: FlowArray | None = None
    extras: Mapping[str, FlowArray] = field(default_factory=dict)
