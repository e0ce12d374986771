"""Edge-aware smoothness (UFlow, ARFlow), of first order the regulariser of the paper's comparison "SelfFlow".

``L_sm = ( exp(-beta |I_x|) (|u_x| + |v_x|) + exp(-beta |I_y|) (|u_y| + |v_y|) ) / 2``, |I_x| as a mean over colours.
Zero for every translation. ARFlow's form of second order takes ``|u_xx| + |v_xx|`` and ``|u_yy| + |v_yy|`` in place of
the first derivatives; it is zero for every affine flow.
"""

import torch

from gelflow.arrays import Flow, Images, Scalar
from gelflow.ops.gradients import forward_differences


def first_order_loss(flow: Flow, image: Images, beta: float = 10.0) -> Scalar:
    """The smoothness loss at one scale; 0 for a single row or column.

    The mean is over the pixels that have a right and a lower neighbour and over both directions. The flow is in px or
    divided by the image's shorter side; `beta` is the weight's steepness in the image gradient.
    """
    if min(flow.shape[-2:]) < 2:
        return flow.sum() * 0
    terms = [
        torch.exp(-beta * brightness.abs().mean(dim=1, keepdim=True)) * motion.abs().sum(dim=1, keepdim=True)
        for brightness, motion in zip(forward_differences(image), forward_differences(flow), strict=True)
    ]
    return (terms[0] + terms[1]).mean() / 2


def second_order_loss(flow: Flow, image: Images, beta: float = 10.0) -> Scalar:
    """The smoothness loss of second order at one scale, 0 where a side is below 3; arguments as for `first_order_loss`.

    The second difference of the flow around a pixel is weighted by the image's step from that pixel to the next. The
    mean is over the pixels that have all four neighbours and over both directions.
    """
    if min(flow.shape[-2:]) < 3:
        return flow.sum() * 0
    centre = 2 * flow[..., 1:-1, 1:-1]
    across = flow[..., 1:-1, 2:] + flow[..., 1:-1, :-2] - centre
    down = flow[..., 2:, 1:-1] + flow[..., :-2, 1:-1] - centre
    terms = [
        torch.exp(-beta * brightness[..., 1:, 1:].abs().mean(dim=1, keepdim=True)) * bend.abs().sum(dim=1, keepdim=True)
        for brightness, bend in zip(forward_differences(image), (across, down), strict=True)
    ]
    return (terms[0] + terms[1]).mean() / 2
