"""Augmentation of whole batches, on whatever device they are: motion, flips, colours, specks, compression.

Motion: image 2 is read at ``A(y) = c + M (y - c) + t``, c its centre and M = s R, so that what lay at A(y) lies at y. A
point of image 1 that was found at x + V(x) is then found at ``x + V'(x) = c + M^-1 (x + V(x) - c - t)``. The flow stays
exact; image 2 is resampled by splines, its border repeated outside. Lights are turned with the gel, which real lights
are not: angles and shifts should stay small beside the motion of the recordings that the network is meant for.

Synthetic pairs of bare gels are neither moved nor flipped nor recoloured: what is read from them is shading, and it is
where the lights are that gives slopes their colours. Changed so they would be pictures of no sensor.

Each pair has its own random numbers. They are sampled on the CPU and copied asynchronously, so that a GPU need not
finish a step before the CPU prepares the next.

Specks in the optics (`gelflow.training.specks`) stand still, whatever moves. Compression comes last, by a step that is
log-uniform between MILDEST times the configured one and that one. Only pairs with exact flow get either, and those of
bare gels do not.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.config import MotionConfig, TrainConfig
from gelflow.ops.compression import compressed
from gelflow.ops.warp import from_centre, warp
from gelflow.training.specks import specked

UNCHANGED = np.array([1, 0, 0, 1, 1, 0, 0, 1, 0, 0, 1, 1, 1, 1, 1, 0], np.float32)
"""Random numbers, in the order of `_sampled`, that leave a pair as it is."""
MILDEST = 1 / 32
"""Smallest step of the compression, over the largest."""


def augmented(batch: dict[str, Any], config: TrainConfig, randoms: Sequence[np.random.Generator]) -> dict[str, Any]:
    """A new batch, after the augmentation that the configuration asks for.

    It holds image1, image2 (B, 3, H, W); bare, whose gels have no pattern; perhaps flow (B, 2, H, W) px, NaN where
    unknown; what else it holds is passed on. There is a source of random numbers for each pair.
    """
    new = dict(batch)
    sampled = [
        UNCHANGED if bare else _sampled(config, random) for bare, random in zip(batch["bare"], randoms, strict=True)
    ]
    numbers = torch.from_numpy(np.stack(sampled))
    numbers = numbers.to(batch["image1"], non_blocking=True)
    if config.motion is not None:
        matrices, inverses, shifts = numbers[:, :4].view(-1, 2, 2), numbers[:, 4:8].view(-1, 2, 2), numbers[:, 8:10]
        new["image2"] = moved_images(new["image2"], matrices, shifts)
        if "flow" in new:
            new["flow"] = moved_flow(new["flow"], inverses, shifts)
    if config.flip:
        for column, axis in ((10, -1), (11, -2)):
            turned = numbers[:, column].view(-1, 1, 1, 1) < 0
            for key in ("image1", "image2", "flow"):
                if key in new:
                    new[key] = torch.where(turned, new[key].flip(axis), new[key])
        if "flow" in new:
            new["flow"] = new["flow"] * numbers[:, 10:12, None, None]
    if config.color_jitter > 0:
        gain = numbers[:, 12:15, None, None]
        for key in ("image1", "image2"):
            new[key] = (new[key] * gain).clamp(0, 1)
    if "flow" not in new:
        return new
    # Recordings, which have no flow, have their own specks and are compressed already.
    known = torch.isfinite(new["flow"]).flatten(1).any(dim=1)
    if config.specks > 0:
        both = torch.stack([new["image1"], new["image2"]], dim=1)
        for place, (bare, random) in enumerate(zip(batch["bare"], randoms, strict=True)):
            if not bare and random.random() < config.specks:
                both[place] = torch.where(known[place], specked(both[place], random), both[place])
        new["image1"], new["image2"] = both.unbind(dim=1)
    if config.compression > 0:
        for key in ("image1", "image2"):
            new[key] = compressed(new[key], numbers[:, 15] * known)
    return new


def _sampled(config: TrainConfig, random: np.random.Generator) -> NDArray[np.float32]:
    """M, M^-1, t of the motion, -1 for a flip along x and y, gain of each colour, step of compression: 16 numbers."""
    matrix, shift = np.eye(2), np.zeros(2)
    if config.motion is not None:
        matrix, shift = random_motion(config.motion, random)
    flips = np.where(random.random(2) < 0.5, -1.0, 1.0)
    gain = np.exp(random.normal(0, config.color_jitter, 3))
    step = config.compression * MILDEST ** random.random()
    return np.r_[matrix.ravel(), np.linalg.inv(matrix).ravel(), shift, flips, gain, step].astype(np.float32)


def random_motion(config: MotionConfig, random: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
