"""Pixels whose point is seen in both images, judged by the flows there and back (Meister, Hur and Roth 2018, eq. 3).

Kept where ``|f(x) + b(x + f(x))|^2 <= 0.01 (|f(x)|^2 + |b(x + f(x))|^2) + 0.5 px^2``: a share of the motion and a
constant, so that neither small errors of large motions nor the noise of small ones throw pixels out.
"""

import torch

from gelflow.arrays import Flow, Mask
from gelflow.ops.warp import inside, warp

RELATIVE, ABSOLUTE_PX2 = 0.01, 0.5


def visible_both_ways(forward: Flow, backward: Flow) -> Mask:
    """1 where the flow there and back closes, else 0; also 0 where it leaves the image. Without gradient.

    Args:
        forward: (B, 2, H, W), px.
        backward: The same with the images exchanged.
    """
    with torch.no_grad():
        back = warp(backward, forward)
        closure = (forward + back).square().sum(dim=1, keepdim=True)
        motion = forward.square().sum(dim=1, keepdim=True) + back.square().sum(dim=1, keepdim=True)
        return inside(forward) * (closure <= RELATIVE * motion + ABSOLUTE_PX2).to(forward.dtype)
