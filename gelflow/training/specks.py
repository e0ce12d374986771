"""Random specks in the optics of a pair: dust, bubbles and scratches, which stand still while the gel moves.

A speck is what lies within a radius of a line segment, or its rim alone, with a blurred edge. It covers the same pixels
of both images. Each image adds noise of its own to it: equal pixels would give specks away.
"""

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gelflow.arrays import Images
from gelflow.models.evidence import TINY
from gelflow.ops.warp import pixel_indices

MOST = 12
"""Largest number of specks in a pair; the least is one."""
DUST, BUBBLE, SCRATCH = range(3)
KINDS = (0.5, 0.25, 0.25)
"""Their shares."""
RADIUS_PX, SCRATCH_PX = (0.7, 7.0), (0.4, 1.5)
"""Least and largest radius."""
LENGTH_PX, RIM_PX, EDGE_PX = (4.0, 40.0), (0.5, 1.5), (0.3, 1.5)
"""Of a scratch's segment; half the width of a bubble's rim; the logistic scale of an edge."""
OPACITY, NOISE = (0.4, 1.0), (0.001, 0.01)
"""Share of the gel's light that a speck takes, and the noise's standard deviation; white is 1."""


def specked(images: Images, random: np.random.Generator) -> Images:
    """Both images of one pair, (2, 3, H, W), with specks that the random numbers alone decide."""
    height, width = images.shape[-2:]
    numbers = torch.from_numpy(_sampled(random, height, width)).to(images, non_blocking=True)
    x, y, right, down, half, radius, rim, edge, opacity, *colour = numbers.view(len(numbers), -1, 1, 1)
    columns, rows = pixel_indices(images)
    along = right * (columns - x) + down * (rows - y)
    across = right * (rows - y) - down * (columns - x)
    inward = radius - torch.hypot((along.abs() - half).clamp(min=0), across)
    inward = torch.where(rim > 0, rim - inward.abs(), inward)
    cover = opacity * torch.sigmoid(inward / edge)
    light = torch.stack([(cover * one).sum(dim=0) for one in colour]) / cover.sum(dim=0).clamp(min=TINY)
    deviation = float(_log_uniform(random, NOISE, 1)[0])
    source = torch.Generator(images.device).manual_seed(int(random.integers(2**31)))
    noise = deviation * torch.randn(images.shape, generator=source, device=images.device)
    clear: Tensor = (1 - cover).prod(dim=0)
    return torch.lerp(light + noise, images, clear).clamp(0, 1)


def _sampled(random: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """Of n specks: place, direction, half length, radius, rim, edge, opacity and three colours, (12, n)."""
    n = int(random.integers(1, MOST + 1))
    kind = random.choice(3, n, p=KINDS)
    place = random.uniform(0, [[width], [height]], (2, n))
    angle = random.uniform(0, np.pi, n)
    half = np.where(kind == SCRATCH, _log_uniform(random, LENGTH_PX, n) / 2, random.uniform(0, 2, n))
    radius = np.where(kind == SCRATCH, _log_uniform(random, SCRATCH_PX, n), _log_uniform(random, RADIUS_PX, n))
    rim = np.where(kind == BUBBLE, _log_uniform(random, RIM_PX, n), 0)
    grey = np.where(random.random(n) < 0.5, random.uniform(0, 0.3, n), random.uniform(0.5, 1, n))
    colours = np.clip(grey + random.normal(0, 0.05, (3, n)), 0, 1)
    edge = _log_uniform(random, EDGE_PX, n)
    opacity = random.uniform(*OPACITY, n)
    numbers = [*place, np.cos(angle), np.sin(angle), half, radius, rim, edge, opacity, *colours]
    return np.stack(numbers).astype(np.float32)


def _log_uniform(random: np.random.Generator, limits: tuple[float, float], n: int) -> NDArray[np.float64]:
    least, most = map(math.log, limits)
    return np.exp(random.uniform(least, most, n))
