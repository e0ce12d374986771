"""Does the true flow have the lowest loss? Counts the pairs on which it beats no flow, 0.9 and 1.1 times itself.

For each configuration of the losses and each scale alone. Pixels that see no gel get no flow; nothing else is hidden
from the losses. The true flow of a coarse scale is its mean over blocks where the loss judges it on images that are
means over the same blocks. Where the loss enlarges it and judges it on the images themselves (`compare_at` = "image"),
it is the coarse flow whose enlargement is nearest to the truth in the sense of least squares: means, enlarged, flatten
every peak.
"""

from argparse import ArgumentParser
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.rows import Row, show
from gelflow.config import LossConfig
from gelflow.config.sources import train_config
from gelflow.data import PairDataset
from gelflow.data.open import open_all
from gelflow.losses import self_supervised_loss
from gelflow.ops.pyramid import enlarge_flow, flow_pyramid

FACTORS = (0.0, 0.9, 1.1)
MAX_ITERATIONS, TOLERANCE = 60, 1e-10
"""Of conjugate gradients; the tolerance is of the squared residual, relative to the first."""


def fitted(flow: Tensor, known: Tensor, start: Tensor, scale: int) -> Tensor:
    """The coarse flow whose enlargement is nearest to a full one: conjugate gradients on the normal equations.

    Full flow (1, 2, H, W) px, which counts where `known` (1, 1, H, W) is 1; the start is in px of the scale, from 1 on.
    """
    size = (flow.shape[-2], flow.shape[-1])

    def transposed(residual: Tensor) -> Tensor:
        with torch.enable_grad():
            at = torch.zeros_like(start, requires_grad=True)
            return torch.autograd.grad((enlarge_flow(at, scale, size) * known * residual).sum(), at)[0]

    found, left = start, transposed(flow - enlarge_flow(start, scale, size))
    direction, squared = left, left.square().sum()
    goal = TOLERANCE * squared
    for _ in range(MAX_ITERATIONS):
        if squared <= goal:
            break
        image = transposed(enlarge_flow(direction, scale, size))
        step = squared / (direction * image).sum()
        found, left = found + step * direction, left - step * image
        before, squared = squared, left.square().sum()
        direction = left + squared / before * direction
    return found


def wins(dataset: PairDataset, loss: LossConfig) -> Tensor:
    """(scales, 3) number of pairs whose true flow has a lower loss than itself times each factor."""
    scales = len(loss.lambda_s)
    counts = torch.zeros(scales, len(FACTORS))
    for index in range(len(dataset)):
        sample = dataset[index]
        image1, image2, flow = (torch.as_tensor(sample[name])[None] for name in ("image1", "image2", "flow"))
        known = torch.isfinite(flow).all(dim=1, keepdim=True).to(flow.dtype)
        flow = torch.nan_to_num(flow)
        flows = flow_pyramid(flow, scales)
        if loss.compare_at == "image":
            flows[1:] = [fitted(flow, known, start, 1 + k) for k, start in enumerate(flows[1:])]
        for scale in range(scales):
            weights = tuple(float(s == scale) for s in range(scales))
            alone = loss.model_copy(update={"lambda_s": weights, "smoothness_s": None})
            values = [self_supervised_loss([f * v for v in flows], image1, image2, alone)[0] for f in (1.0, *FACTORS)]
            counts[scale] += torch.stack([values[0] < value for value in values[1:]])
    return counts


def main(argv: list[str]) -> int:
    """Print the table."""
    parser = ArgumentParser("python -m benchmarks loss_order", description=__doc__)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take each so many pairs one")
    parser.add_argument("--presets", default="paper,selfflow,best,real")
    parser.add_argument("--set", action="append", default=[], help="of the presets, such as loss.alpha=0.85")
    given = parser.parse_args(argv)
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    dataset = open_all(given.datasets)
    dataset = PairDataset(dataset.source, dataset.records[:: given.every])
    rows: list[Row] = []
    for preset in given.presets.split(","):
        for scale, counts in enumerate(wins(dataset, train_config(preset, given.set).loss).int().tolist()):
            beaten = {f"beats {factor:g} x flow": count for factor, count in zip(FACTORS, counts, strict=True)}
            rows.append({"losses": preset, "scale": scale, "pairs": len(dataset), **beaten})
    show(rows, list(rows[0]))
    return 0
