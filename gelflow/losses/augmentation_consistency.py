"""Augmentation consistency (ARFlow, Liu et al. 2020): the flow of a pair should not depend on how the pair is shown.

The images of a pair are transformed alike and the flow that the network found on the originals is transformed with
them; on the transformed images it should find that flow: ``L_ar = mean over valid pixels of (|V' - V*| + 0.01)^0.4``.

Here the transformation is a similarity about the image's centre, x = c + s R (x' - c) + t, with rotation to 0.2 rad,
s from 1/1.5 to 1 (enlarging) and shifts to 2 % of the sides, followed by a gain per colour and noise of 0.02. A point x
with flow V then has the flow (s R)^-1 V at x'. Pixels that come from outside do not count.
"""

import math

import torch
from torch import Tensor

from gelflow.arrays import Flow, Images, Mask, Scalar
from gelflow.ops.warp import from_centre, inside, warp

ROTATION, ENLARGEMENT, SHIFT, GAIN, NOISE = 0.2, 1.5, 0.02, 0.2, 0.02
EPSILON, EXPONENT = 0.01, 0.4


def transformed_pair(
    image1: Images, image2: Images, flow: Flow, random: torch.Generator
) -> tuple[Images, Images, Flow, Mask]:
    """Pairs under one random transformation, the flow that belongs to them, and a mask of the pixels where it is known.

    `random` is a generator on the CPU. No gradient is followed through the flow.
    """
    draw = 2 * torch.rand(7, generator=random, dtype=torch.float64) - 1
    angle, scale = ROTATION * float(draw[0]), ENLARGEMENT ** (float(draw[1]) / 2 - 0.5)
    matrix = scale * torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    height, width = flow.shape[-2:]
    shift = SHIFT * draw[2:4].float() * torch.tensor([width, height])
    motion = displacement(flow, matrix.to(flow), shift.to(flow))
    turned = torch.einsum("ij,bjhw->bihw", torch.linalg.inv(matrix).to(flow), warp(flow.detach(), motion))
    gain = (1 + GAIN * draw[4:7].float()).view(1, 3, 1, 1).to(image1)
    grain = torch.Generator(image1.device).manual_seed(int(torch.randint(2**62, (), generator=random)))
    shown = []
    for image in (image1, image2):
        noise = NOISE * torch.randn(image.shape, generator=grain, device=image.device)
        shown.append((gain * warp(image, motion) + noise).clamp(0, 1))
    return shown[0], shown[1], turned, inside(motion)


def displacement(like: Flow, matrix: Tensor, shift: Tensor) -> Flow:
    """Where each pixel x' of the transformed image comes from, less x': (B, 2, H, W) px."""
    place = from_centre(like)
    moved = torch.einsum("ij,jhw->ihw", matrix, place) + shift.view(2, 1, 1)
    return (moved - place).expand(like.shape[0], -1, -1, -1).contiguous()


def consistency_loss(flow: Flow, target: Flow, pixels: Mask) -> Scalar:
    """L_ar of the flow found on the transformed images against the transformed flow, both (B, 2, H, W) px."""
    distance = (flow - target).abs().sum(dim=1, keepdim=True)
    return (((distance + EPSILON) ** EXPONENT) * pixels).sum() / pixels.sum().clamp(min=1)
