"""Propagation: where a flow does not bring the images together, the flow of a place nearby that does.

Gauss-Newton steps find the minimum that they start near. A network that loses a dot leaves a patch of flow from which
none of its steps leads back, while the flow of the gel beside the patch would. So each pixel is offered the
flow of its neighbours at some distances, and takes the one that lessens its windowed residual most,

    E(x) = sum_y w(y - x) c(y) |F2(y + V(y)) - F1(y)|^2 / sum_y w(y - x) c(y)

if by enough (c is 1 where the flow stays in the image). The flow of a whole patch can spread that way, a distance at a
time; nothing is searched for, so that a pattern's period offers nothing that is not some neighbour's flow already. A
window that the flow takes out of the image has no residual, and takes a neighbour's flow that keeps it inside.

After the propagation of PatchMatch (Barnes et al. 2009), without its random search.
"""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from gelflow.arrays import Flow, Images
from gelflow.ops.gaussian import WindowSums
from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import inside_at, positions

DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, 1), (-1, 1), (1, -1))
ROUNDS = 2
"""In each, a pixel is offered what its neighbours had at the end of the round before."""
ENOUGH = 0.8
"""A neighbour's flow is taken where it leaves less than this share of the residual."""
SHARE_INSIDE = 0.3
"""Of a window's weight: with less of it in the image, flows are not compared."""


def propagated(
    flow: Flow, first: Images, second: SplineImage, window: WindowSums, distances: Sequence[int], noise: float
) -> Flow:
    """The flow, with what its neighbours know.

    Args:
        flow: (B, 2, H, W), px.
        first: (B, C, H, W), image 1.
        second: Image 2, the same shape.
        window: w.
        distances: Of the neighbours, px, each in eight directions.
        noise: Standard deviation of the residual that is believed; where it is below twice that, the flow stays.

    Returns:
        Same shape; every vector is one of `flow`.
    """
    whole = window(torch.ones_like(flow[:, :1]))

    def residual(candidate: Flow) -> Tensor:
        """E, (B, 1, H, W); infinite where too little of the window is in the image."""
        places = positions(candidate)
        counts = inside_at(places)
        squares = counts * (second.at(places) - first).square().mean(dim=1, keepdim=True)
        weighed, weight = window(torch.cat([squares, counts], dim=1)).split(1, dim=1)
        return torch.where(weight > SHARE_INSIDE * whole, weighed / weight, torch.inf)

    for _ in range(ROUNDS):
        now = residual(flow)
        best, least = flow, ENOUGH * now
        for distance in distances:
            for right, down in DIRECTIONS:
                offered = _neighbours(flow, distance * right, distance * down)
                left = residual(offered)
                best, least = torch.where(left < least, offered, best), torch.minimum(left, least)
        flow = torch.where(now > (2 * noise) ** 2, best, flow)
    return flow


def _neighbours(flow: Flow, right: int, down: int) -> Flow:
    """The flow at x + (right, down), at the border that of the pixel nearest to it."""
    margin = max(abs(right), abs(down))
    rows, columns = flow.shape[-2:]
    padded = pad(flow, (margin,) * 4, mode="replicate")
    return padded[..., margin + down : margin + down + rows, margin + right : margin + right + columns]
