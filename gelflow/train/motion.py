"""More motion for a pair whose flow is known or not: image 2 is shifted, turned and enlarged, and the flow with it.

Image 2 is read at ``A(y) = c + s R (y - c) + t``, c its centre, so that what lay at A(y) lies at y. A point of image 1
that was found at x + V(x) is then found at ``x + V'(x) = c + R^-1 (x + V(x) - c - t) / s``. The flow stays exact;
image 2 is resampled (bicubic), and where A(y) lies outside its border is repeated.

Lights are turned with the gel, which real lights are not: angles and shifts should stay small beside the motion of the
recordings that the network is meant for.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gelflow.config import MotionConfig
from gelflow.losses.analogy import displacement
from gelflow.ops.warp import pixel_indices, warp


def with_more_motion(sample: dict[str, Any], config: MotionConfig, random: np.random.Generator) -> dict[str, Any]:
    """The sample with another image 2 and, where it has a flow, the flow that belongs to it.

    Args:
        sample: image1, image2 (3, H, W); perhaps flow (2, H, W) px, NaN where unknown.
        config: Limits of the motion that is added.
        random: Source of the draw; five numbers are taken.

    Returns:
        A new sample; what is not named above is passed on.
    """
    # The common factor makes small additions as frequent as large ones, in all of them at once.
    shift_x, shift_y, angle, zoom = random.random() * random.uniform(-1, 1, 4)
    angle, zoom = math.radians(config.turn_deg) * angle, (1 + config.zoom) ** zoom
    matrix = zoom * torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    shift = config.shift_px * torch.tensor([shift_x, shift_y])
    image2: Tensor = sample["image2"][None]
    inverse = torch.linalg.inv(matrix)
    # Not blocking: the CPU draws the next sample while the device is busy with the last step.
    matrix, inverse, shift = (value.to(image2, non_blocking=True) for value in (matrix, inverse, shift))
    added = displacement(image2[:, :2], matrix, shift)
    new = dict(sample, image2=warp(image2, added, "bicubic").clamp(0, 1)[0])
    if "flow" in sample:
        new["flow"] = _composed(sample["flow"], inverse, shift)
    return new


def _composed(flow: Tensor, inverse: Tensor, shift: Tensor) -> Tensor:
    """V' of a flow V (2, H, W), px."""
    columns, rows = pixel_indices(flow[None])
    height, width = flow.shape[-2:]
    x, y = columns[0] - (width - 1) / 2, rows[0] - (height - 1) / 2
    place = torch.stack([x.expand(height, width), y.expand(height, width)])
    return torch.einsum("ij,jhw->ihw", inverse, place + flow - shift.view(2, 1, 1)) - place
