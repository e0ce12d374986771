"""From a data set of pairs to batches: the order of the pairs, resizing, cropping, augmentation.

Draw k of a run (k = 0, 1, ...) is a pair and its augmentation, both fixed by (seed, k) alone: by neither the number of
workers nor where a run was interrupted. Each pass over the pairs is a new permutation.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch.utils.data import Dataset, Sampler

from gelflow.config import MINIMUM_SIDE, TrainConfig
from gelflow.errors import InputError
from gelflow.ops.pyramid import resize_flow, resize_images
from gelflow.training.augment import augmented

Sample = dict[str, Any]
"""image1, image2: (3, H, W) float32 in [0, 1]; name; perhaps bare: whether the gel has no pattern; perhaps flow:
(2, H, W) float32, px, NaN where no gel is seen."""

ORDER, AUGMENTATION = 0, 1
"""Purpose of a random stream: the second word of its seed, after the run's."""


class StepSampler(Sampler[list[tuple[int, int]]]):
    """Batches of (index of the pair, draw) for the optimiser steps start .. stop-1 of one of `world` processes."""

    def __init__(self, pairs: int, config: TrainConfig, start: int, stop: int, rank: int = 0, world: int = 1) -> None:
        self.pairs = pairs
        self.seed = config.seed
        self.size = config.batch_size
        self.steps = range(start, stop)
        self.rank = rank
        self.world = world

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        orders: dict[int, np.ndarray] = {}
        for step in self.steps:
            first = (step * self.world + self.rank) * self.size
            batch = []
            for draw in range(first, first + self.size):
                turn, place = divmod(draw, self.pairs)
                if turn not in orders:
                    orders = {turn: np.random.default_rng([self.seed, ORDER, turn]).permutation(self.pairs)}
                batch.append((int(orders[turn][place]), draw))
            yield batch


class CheckedPairs(Dataset[Sample]):
    """Pairs with what training needs of them, see `checked`."""

    def __init__(self, pairs: Dataset[Any], supervised: bool) -> None:
        self.pairs = pairs
        self.supervised = supervised

    def __len__(self) -> int:
        return len(self.pairs)  # type: ignore[arg-type]  # Dataset itself declares no __len__

    def __getitem__(self, index: int) -> Sample:
        return checked(self.pairs[index], self.supervised)


class TrainingSamples(Dataset[tuple[Sample, np.random.Generator]]):
    """Pairs at `StepSampler`'s keys, resized and cropped, each with the source of its augmentation's random numbers."""

    def __init__(self, pairs: Dataset[Sample], config: TrainConfig) -> None:
        self.pairs = pairs
        self.config = config

    def __getitem__(self, key: tuple[int, int]) -> tuple[Sample, np.random.Generator]:
        index, draw = key
        sample = self.pairs[index]
        if self.config.image_size is not None:
            sample = resized(sample, self.config.image_size)
        elif min(sample["image1"].shape[1:]) < MINIMUM_SIDE:
            size = "x".join(str(side) for side in sample["image1"].shape[1:])
            raise InputError(f"pair {sample['name']}: {size} px, but each side must be at least {MINIMUM_SIDE} px; "
                             "set image_size to enlarge the images")  # fmt: skip
        random = np.random.default_rng([self.config.seed, AUGMENTATION, draw])
        return cropped(sample, self.config, random), random


def augmented_batch(drawn: Sequence[tuple[Sample, np.random.Generator]], config: TrainConfig) -> Sample:
    """Samples of `TrainingSamples` as a batch, each pair augmented by its own source of random numbers."""
    return augmented(collate([sample for sample, _ in drawn]), config, [random for _, random in drawn])


def checked(sample: Sample, supervised: bool = False) -> Sample:
    """What training needs of a sample; InputError where it lacks the exact flow of supervised training."""
    flow = sample.get("flow")
    if supervised and (flow is None or not torch.isfinite(flow).any()):
        raise InputError(
            f'pair {sample["name"]}: has no exact flow, which supervision = "flow" and "registered" need; '
            'use supervision = "self"'
        )
    return {key: sample[key] for key in ("image1", "image2", "bare", "name", "flow") if key in sample}


def resized(sample: Sample, size: tuple[int, int]) -> Sample:
    """The sample at another size, its flow in px of that size."""
    new = dict(sample)
    for key in ("image1", "image2"):
        new[key] = resize_images(sample[key][None], size)[0]
    if "flow" in sample:
        new["flow"] = resize_flow(sample["flow"][None], size)[0]
    return new


def cropped(sample: Sample, config: TrainConfig, random: np.random.Generator) -> Sample:
    """A random crop of the configuration's size, if it has one.

    Images whose flow is known and that are smaller than the crop are continued beyond their border by its colours, with
    no flow there, so that data sets of several sensors can be trained on together.
    """
    if config.crop_size is None:
        return sample
    rows, columns = config.crop_size
    height, width = sample["image1"].shape[-2:]
    if (rows > height or columns > width) and not _supervised(sample, config):
        raise InputError(f"pair {sample['name']}: crop_size {rows}x{columns} does not fit into its {height}x{width} px")
    down, right = max(rows - height, 0), max(columns - width, 0)
    above, before = random.integers(down + 1), random.integers(right + 1)
    top, left = random.integers(max(height - rows, 0) + 1), random.integers(max(width - columns, 0) + 1)
    new = dict(sample)
    for key in ("image1", "image2", "flow"):
        if key in sample:
            cut = sample[key][:, top : top + rows, left : left + columns]
            if down or right:
                border = (before, right - before, above, down - above)
                cut = F.pad(cut, border, value=torch.nan) if key == "flow" else F.pad(cut, border, mode="replicate")
            new[key] = cut
    return new


def _supervised(sample: Sample, config: TrainConfig) -> bool:
    if config.supervision == "mixed":
        return "flow" in sample and bool(torch.isfinite(sample["flow"]).any())
    return config.exact


def collate(samples: list[Sample]) -> Sample:
    """A batch from samples of one size, NaN for flow that only others have. InputError for several sizes."""
    sizes = {tuple(sample["image1"].shape[-2:]) for sample in samples}
    if len(sizes) > 1:
        names = ", ".join(str(sample["name"]) for sample in samples)
        raise InputError(f"pairs {names} have images of different sizes; set image_size (or crop_size) to one size")
    batch: Sample = {key: torch.stack([sample[key] for sample in samples]) for key in ("image1", "image2")}
    if any("flow" in sample for sample in samples):
        unknown = torch.full((2, *sizes.pop()), torch.nan)
        batch["flow"] = torch.stack([sample.get("flow", unknown) for sample in samples])
    batch["name"] = [sample["name"] for sample in samples]
    batch["bare"] = [bool(sample.get("bare")) for sample in samples]
    return batch
