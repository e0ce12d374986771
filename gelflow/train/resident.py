"""Pairs that are decoded once and stay on the CUDA device: there, decoding files would take far longer than training.

Images whose values are whole 255ths stay bytes; everything else is float32, so that samples are those of the files bit
by bit.
"""

from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from gelflow.train.samples import CheckedPairs, Sample

SHARE_OF_MEMORY = 0.5
"""Largest share of the device's free memory that pairs may take."""


class ResidentPairs(Dataset[Sample]):
    """Checked samples on a device; see `resident`."""

    def __init__(self, samples: list[Sample]) -> None:
        self._samples = samples

    def __len__(self) -> int:
        return len(self._samples)

    def __getitem__(self, index: int) -> Sample:
        return {key: _unpacked(value) for key, value in self._samples[index].items()}


def resident(
    pairs: CheckedPairs, device: torch.device, *, room: int | None = None, **loading: Any
) -> ResidentPairs | None:
    """Decodes all pairs and puts them on a device; None where they do not fit. InputError for one that cannot be used.

    `room` is the number of bytes that they may take; None: half of what is free on the CUDA device. `loading` says how
    the DataLoader that decodes them starts its processes; empty: this process decodes.
    """
    if room is None:
        room = int(SHARE_OF_MEMORY * torch.cuda.mem_get_info(device)[0])
    samples: list[Sample] = []
    for sample in DataLoader(pairs, batch_size=None, **loading):
        packed = {key: _packed(value) for key, value in sample.items()}
        room -= sum(value.nbytes for value in packed.values() if isinstance(value, Tensor))
        if room < 0:
            return None
        samples.append({key: value.to(device) if isinstance(value, Tensor) else value for key, value in packed.items()})
    return ResidentPairs(samples)


def _packed(value: Any) -> Any:
    if not isinstance(value, Tensor) or value.shape[0] != 3:
        return value
    levels = (255 * value).round()
    return levels.to(torch.uint8) if torch.equal(levels.clamp(0, 255) / 255, value) else value


def _unpacked(value: Any) -> Any:
    return value.float() / 255 if isinstance(value, Tensor) and value.dtype == torch.uint8 else value
