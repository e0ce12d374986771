"""Parts of the network as kernels for CUDA devices, see `gelflow.ops.kernels`; without gradient."""

import torch
import warp as wp
from torch import Tensor

from gelflow.arrays import Features, Flow
from gelflow.ops.kernels import Field, bilinear, launch


def add_bias(found: Features, bias: Tensor, slope: float) -> Features:
    """What a convolution found (B, C, H, W), changed to the leaky ReLU of its sum with the bias (C,)."""
    launch(_add_bias, found.permute(0, 2, 3, 1), bias, slope, by_channel=True)  # channels lie side by side
    return found


@wp.kernel
def _add_bias(bias: wp.array(dtype=wp.float32), slope: float, out: Field):
    b, y, x, c = wp.tid()
    found = out[b, y, x, c] + bias[c]
    out[b, y, x, c] = wp.where(found < 0.0, slope * found, found)


def side_by_side(first: Features, second: Features, flow: Flow) -> Tensor:
    """The features of image 1 and those of image 2 warped by a flow, (2 B, C, H, W)."""
    out = flow.new_empty(2 * len(first), *first.shape[1:])
    return launch(_side_by_side, out, first.float(), second.float(), flow, by_channel=True)


@wp.kernel
def _side_by_side(first: Field, second: Field, flow: Field, out: Field):
    i, c, y, x = wp.tid()
    b = i % first.shape[0]
    if i < first.shape[0]:
        out[i, c, y, x] = first[b, c, y, x]
    else:
        out[i, c, y, x] = bilinear(second, b, c, float(x) + flow[b, 0, y, x], float(y) + flow[b, 1, y, x])


def costs(both: Tensor, mean: Tensor, variance: Tensor, radius: int, slope: float) -> Tensor:
    """The cost volume of `side_by_side` features less a mean, over a variance, both (B,), after a leaky ReLU."""
    out = both.new_empty(len(both) // 2, (2 * radius + 1) ** 2, *both.shape[2:])
    return launch(_costs, out, both, mean, variance, radius, slope, by_channel=True)


@wp.kernel
def _costs(
    both: Field,
    mean: wp.array(dtype=wp.float32),
    variance: wp.array(dtype=wp.float32),
    r: int,
    slope: float,
    out: Field,
):
    b, d, y, x = wp.tid()
    row, column = y + d // (2 * r + 1) - r, x + d % (2 * r + 1) - r
    total = wp.float32(0.0)
    if row >= 0 and row < both.shape[2] and column >= 0 and column < both.shape[3]:
        for c in range(both.shape[1]):
            total += (both[b, c, y, x] - mean[b]) * (both[b + out.shape[0], c, row, column] - mean[b])
    total /= variance[b] * float(both.shape[1])
    out[b, d, y, x] = wp.where(total < 0.0, slope * total, total)


def locally_fused(flow: Flow, context: Features, share: float) -> Flow:
    """`layers.LocalFlowFusion` of a flow by the context; `share` times the sum over channels is the similarity."""
    return launch(_locally_fused, torch.empty_like(flow), flow, context, share)


@wp.kernel
def _locally_fused(flow: Field, context: Field, share: float, out: Field):
    b, y, x = wp.tid()
    most, total, u, v = wp.float32(-wp.inf), wp.float32(0.0), wp.float32(0.0), wp.float32(0.0)
    for i in range(9):
        row, column = y + i // 3 - 1, x + i % 3 - 1
        if row >= 0 and row < flow.shape[2] and column >= 0 and column < flow.shape[3]:
            similarity = wp.float32(0.0)
            for c in range(context.shape[1]):
                similarity += context[b, c, y, x] * context[b, c, row, column]
            similarity *= share
            # The weights so far are over exp(most).
            shrunk, weight = wp.exp(most - wp.max(most, similarity)), wp.exp(similarity - wp.max(most, similarity))
            most = wp.max(most, similarity)
            total = total * shrunk + weight
            u = u * shrunk + weight * flow[b, 0, row, column]
            v = v * shrunk + weight * flow[b, 1, row, column]
    out[b, 0, y, x] = u / total
    out[b, 1, y, x] = v / total
