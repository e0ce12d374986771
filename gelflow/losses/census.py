"""Ternary census loss (Meister, Hur and Roth, "UnFlow", 2018): compares patterns, not brightness.

Each pixel is described by the soft signs of its 48 neighbours' grey values against its own,
``t_d = g_d / sqrt(0.81 + g_d^2)`` with ``g_d = I(x + d) - I(x)`` in grey levels of 255. The distance of two pixels is
``D = sum_d q_d / (0.1 + q_d)``, ``q_d = (t1_d - t2_d)^2``, and the loss the mean of ``(D^2 + 0.001^2)^0.45`` over the
pixels whose 7x7 window lies inside the image and is compared throughout. A gain of brightness common to a window
changes it little, an offset not at all.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Images, Mask, Scalar

RADIUS = 3
"""Of the window, px."""


def census_signs(image: Images) -> Tensor:
    """The signs t of all neighbours, (B, 48, H - 6, W - 6), for images (B, 3, H, W) in [0, 1]."""
    luma = image.new_tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)
    grey = 255 * (luma * image).sum(dim=1, keepdim=True)
    height, width = grey.shape[-2] - 2 * RADIUS, grey.shape[-1] - 2 * RADIUS
    centre = grey[..., RADIUS : RADIUS + height, RADIUS : RADIUS + width]
    side = range(2 * RADIUS + 1)
    steps = [
        grey[..., row : row + height, column : column + width] - centre
        for row in side
        for column in side
        if (row, column) != (RADIUS, RADIUS)
    ]
    step = torch.cat(steps, dim=1)
    return step / torch.sqrt(0.81 + step.square())


def census_loss(image1: Images, warped: Images, pixels: Mask | None) -> Scalar:
    """The census loss at one scale.

    Args:
        image1: (B, 3, H, W) in [0, 1].
        warped: Image 2 brought to image 1, the same shape.
        pixels: (B, 1, H, W), 1 where the warped image is worth comparing; None: everywhere.

    Returns:
        A scalar >= 0 and below 0.001 for equal images. 0 for a scale of fewer than 7x7 px, which has no window, and
        where no window counts.
    """
    if min(image1.shape[-2:]) < 2 * RADIUS + 1:
        return warped.sum() * 0
    difference = (census_signs(image1) - census_signs(warped)).square()
    distance = (difference / (0.1 + difference)).sum(dim=1, keepdim=True)
    cost = (distance.square() + 1e-6) ** 0.45 - 1e-6**0.45
    if pixels is None:
        return cost.mean()
    windows = -F.max_pool2d(-pixels, 2 * RADIUS + 1, stride=1)
    return (cost * windows).sum() / windows.sum().clamp(min=1)
