"""Pixels whose point is seen in both images, by the flows there and back (Meister, Hur and Roth 2018, eq. 3).

A pixel counts where ``|f(x) + b(x + f(x))|^2 <= 0.01 (|f(x)|^2 + |b(x + f(x))|^2) + 0.5 px^2``: a share of the motion
and a constant, so that neither small errors of large motions nor the noise of small ones exclude pixels. Where hardly
a pixel of a pair would be left, the flow is wrong and not the scene hidden, and all pixels count: a loss over none has
no gradient.
"""

import torch

from gelflow.arrays import Flow, Mask
from gelflow.ops.warp import inside, warp

RELATIVE, ABSOLUTE_PX2 = 0.01, 0.5
MIN_VISIBLE_SHARE = 0.1
"""Share of a pair's pixels below which the flow counts as wrong and no pixel as hidden."""


def visible_in_both_images(forward: Flow, backward: Flow) -> Mask:
    """1 where the flow there and back closes, else 0; also 0 where it leaves the image. Without gradient.

    Pairs with less than `MIN_VISIBLE_SHARE` of such pixels have 1 wherever the flow does not leave the image.
    """
    with torch.no_grad():
        back = warp(backward, forward)
        closure = (forward + back).square().sum(dim=1, keepdim=True)
        motion = forward.square().sum(dim=1, keepdim=True) + back.square().sum(dim=1, keepdim=True)
        closed = closure <= RELATIVE * motion + ABSOLUTE_PX2
        closes_anywhere = closed.float().mean(dim=(1, 2, 3), keepdim=True) >= MIN_VISIBLE_SHARE
        return inside(forward) * (closed | ~closes_anywhere).to(forward.dtype)
