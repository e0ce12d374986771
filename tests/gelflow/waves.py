"""Torch images whose motion is known in closed form: plane waves evaluated at moved positions, nothing resampled."""

import math
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import Dataset

from gelflow.config import ModelConfig, TrainConfig
from gelflow.models import GelFlow
from gelflow.models.weights import load_weights, save_weights


def pixel_centres(height: int, width: int) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return x.double(), y.double()


def wave_image(x: Tensor, y: Tensor, seed: int, shortest: float = 8.0, longest: float = 24.0) -> Tensor:
    """(3, H, W) float64 at positions in px: 0.5 plus 24 waves of random length, direction and phase up to 0.05 high."""
    random = torch.Generator().manual_seed(seed)
    total = torch.zeros(3, *x.shape, dtype=torch.float64)
    for _ in range(24):
        length, angle, phase, *colour = torch.rand(6, generator=random, dtype=torch.float64).tolist()
        number = 2 * math.pi / (shortest + (longest - shortest) * length)
        wave = torch.sin(number * (math.cos(math.pi * angle) * x + math.sin(math.pi * angle) * y) + 2 * math.pi * phase)
        total += wave * torch.tensor(colour, dtype=torch.float64).view(3, 1, 1)
    return 0.5 + 0.05 * total


def press_flow(height: int, width: int, largest: float) -> Tensor:
    """(2, H, W) float64, px: outward from the centre, as under a pressed sphere, plus a little shear."""
    x, y = pixel_centres(height, width)
    x, y, radius = x - width / 2, y - height / 2, min(height, width) / 5
    bump = torch.exp(-(x**2 + y**2) / (2 * radius**2))
    flow = torch.stack([x / radius + 0.3, y / radius - 0.2]) * bump
    return largest * flow / flow.norm(dim=0).max()


def moved_pair(flow: Tensor, seed: int, shortest: float = 8.0, longest: float = 24.0) -> tuple[Tensor, Tensor]:
    """image1 and image2, (3, H, W) float64, with image1(x) = image2(x + flow(x)) exactly."""
    x, y = pixel_centres(*flow.shape[1:])
    waves = (seed, shortest, longest)
    return wave_image(x + flow[0], y + flow[1], *waves), wave_image(x, y, *waves)


class Shifts(Dataset):
    """Pairs of side x side px moved by a constant flow each, at most `largest` px along each axis."""

    def __init__(self, pairs: int, side: int, largest: float, seed: int, *, flow: bool = True) -> None:
        random = torch.Generator().manual_seed(seed)
        self.samples = []
        for number in range(pairs):
            shift = largest * (2 * torch.rand(2, 1, 1, generator=random, dtype=torch.float64) - 1)
            field = shift.expand(2, side, side)
            image1, image2 = moved_pair(field, 1000 * seed + number)
            sample = {"image1": image1.float(), "image2": image2.float(), "name": f"shift_{number}"}
            if flow:
                sample |= {"flow": field.float().clone(), "visible": torch.ones(1, side, side)}
            self.samples.append(sample)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> dict:
        return dict(self.samples[index])


SMALL = {
    "model": {"levels": 4, "projected_channels": 8},
    "loss": {"lambda_s": [1.0, 1.0, 1.0]},
    "batch_size": 2,
    "learning_rate": 1e-3,
    "device": "cpu",
}


def small(**values: object) -> TrainConfig:
    """Settings of a run of a small network on a CPU, on one thread, so that it ends the same on every machine."""
    torch.set_num_threads(1)
    return TrainConfig.model_validate(SMALL | values)


def weights_of(path: Path) -> dict[str, Tensor]:
    return load_weights(path).state_dict()


def same_weights(first: Path, second: Path) -> bool:
    one, two = weights_of(first), weights_of(second)
    return one.keys() == two.keys() and all(torch.equal(one[name], two[name]) for name in one)


def random_weights(path: Path, model: ModelConfig, train: TrainConfig | None = None, size: tuple | None = None) -> Path:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    network = GelFlow(model)
    network.image_size = size
    save_weights(path, network, step="7", **({} if train is None else {"train": train.model_dump_json()}))
    return path
