"""Kernels for CUDA devices: each does in one launch what takes PyTorch many, and launching is what takes time there.

Warp compiles them, without a compiler on the user's machine, when one is first launched, and keeps them on disk. Only
functions that compute on such a device load it. The kernels themselves run on processors, too.
"""

import functools
from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_ERROR  # no banner in the user's output
wp.config.enable_backward = False
wp.init()

Field = wp.array4d(dtype=wp.float32)
"""Arrays (B, C, H, W)."""


def launch(kernel: Any, out: Tensor, *inputs: Tensor | float, by_channel: bool = False) -> Tensor:
    """Fills `out` (B, C, H, W) and returns it; CUDA graphs record it.

    There is one thread for each sample and pixel (b, y, x), or for each (b, c, y, x).
    """
    batch, channels, height, width = out.shape
    threads = (batch, channels, height, width) if by_channel else (batch, height, width)
    arrays = [wp.from_torch(each) if isinstance(each, Tensor) else each for each in (*inputs, out)]
    stream = _stream(torch.cuda.current_stream(out.device)) if out.device.type == "cuda" else None
    wp.launch(kernel, threads, arrays, device=wp.device_from_torch(out.device), stream=stream)
    return out


_stream = functools.cache(wp.stream_from_torch)


@wp.func
def is_inside(flow: Field, b: int, y: int, x: int):
    """1 where a pixel's flow stays between the pixel centres, else 0."""
    column, row = float(x) + flow[b, 0, y, x], float(y) + flow[b, 1, y, x]
    stays = column >= 0.0 and column <= float(flow.shape[3] - 1) and row >= 0.0 and row <= float(flow.shape[2] - 1)
    return wp.where(stays, 1.0, 0.0)


@wp.func
def bilinear(image: Field, b: int, c: int, column: float, row: float):
    """A channel at indices that may be fractions; outside, its border."""
    x, y = wp.clamp(column, 0.0, float(image.shape[3] - 1)), wp.clamp(row, 0.0, float(image.shape[2] - 1))
    left, top = int(x), int(y)
    right, bottom = wp.min(left + 1, image.shape[3] - 1), wp.min(top + 1, image.shape[2] - 1)
    above = wp.lerp(image[b, c, top, left], image[b, c, top, right], x - float(left))
    below = wp.lerp(image[b, c, bottom, left], image[b, c, bottom, right], x - float(left))
    return wp.lerp(above, below, y - float(top))


def sampled(image: Tensor, places: Tensor, scale: float) -> Tensor:
    """An image (B, C, s H, s W) with `scale` s px for one of the places (B, 2, H', W'), bilinear: (B, C, H', W')."""
    out = image.new_empty(*image.shape[:2], *places.shape[2:])
    return launch(_sampled, out, image, places, scale)


@wp.kernel
def _sampled(image: Field, places: Field, scale: float, out: Field):
    b, y, x = wp.tid()
    column, row = scale * (places[b, 0, y, x] + 0.5) - 0.5, scale * (places[b, 1, y, x] + 0.5) - 0.5
    for c in range(image.shape[1]):
        out[b, c, y, x] = bilinear(image, b, c, column, row)
