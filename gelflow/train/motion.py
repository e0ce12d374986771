"""More motion for pairs whose flow is known or not: image 2 is shifted, turned and enlarged, and the flow with it.

Image 2 is read at ``A(y) = c + M (y - c) + t``, c its centre and M = s R, so that what lay at A(y) lies at y. A point
of image 1 that was found at x + V(x) is then found at ``x + V'(x) = c + M^-1 (x + V(x) - c - t)``. The flow stays
exact; image 2 is resampled (by splines), and where A(y) lies outside its border is repeated.

Lights are turned with the gel, which real lights are not: angles and shifts should stay small beside the motion of the
recordings that the network is meant for.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.config import MotionConfig
from gelflow.ops.warp import from_centre, warp


def drawn_motion(config: MotionConfig, random: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """M (2, 2) and t (2,) in px of a random motion; five numbers are taken."""
    # The common factor makes small additions as frequent as large ones, in all of them at once.
    shift_x, shift_y, angle, zoom = random.random() * random.uniform(-1, 1, 4)
    angle, zoom = math.radians(config.turn_deg) * angle, (1 + config.zoom) ** zoom
    matrix = zoom * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return matrix, config.shift_px * np.array([shift_x, shift_y])


def moved_images(images: Images, matrices: Tensor, shifts: Tensor) -> Images:
    """Second images (B, C, H, W) read at A(y); M is (B, 2, 2), t is (B, 2) in px."""
    place = from_centre(images)
    more = torch.einsum("bij,jhw->bihw", matrices, place) - place + shifts[:, :, None, None]
    return warp(images, more, "spline").clamp(0, 1)


def moved_flow(flow: Flow, inverses: Tensor, shifts: Tensor) -> Flow:
    """V' of flows V (B, 2, H, W), px; NaN stays NaN. M^-1 is (B, 2, 2), t is (B, 2) in px."""
    place = from_centre(flow)
    return torch.einsum("bij,bjhw->bihw", inverses, place + flow - shifts[:, :, None, None]) - place
