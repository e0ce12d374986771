"""Does the true flow score best? `python docs/loss_order.py data/test/* --every 5`

For each configuration and each scale alone: the number of pairs whose true flow has a lower loss than no flow, than
0.9 and than 1.1 times itself, and what those that fail where the configuration judges move by. Pixels that see no gel
get no flow; nothing else is hidden from the losses.

The true flow of a coarse scale is its mean over blocks where the loss judges it on images that are means over the same
blocks. Where the loss enlarges it and judges it on the images themselves (`compare_at` = "image"), it is the coarse
flow whose enlargement is nearest to the truth in the sense of least squares: means, enlarged, flatten every peak, and a
tenth more would lie nearer.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gelflow.compare.report import markdown
from gelflow.config.sources import train_config
from gelflow.data import PairDataset, open_all
from gelflow.losses import self_supervised_loss
from gelflow.ops.pyramid import enlarge_flow, flow_pyramid

FACTORS = (0.0, 0.9, 1.1)
ITERATIONS, ENOUGH = 60, 1e-10
"""Of conjugate gradients: at most, and the squared residual, relative, that ends them."""


def fitted(flow: Tensor, known: Tensor, start: Tensor, scale: int) -> Tensor:
    """The flow of a scale whose enlargement is nearest to a full one: conjugate gradients on the normal equations.

    Args:
        flow: (1, 2, H, W), px.
        known: (1, 1, H, W), 1 where it counts.
        start: (1, 2, ceil(H / 2^scale), ceil(W / 2^scale)), px of the scale.
        scale: From 1 on.
    """
    size = (flow.shape[-2], flow.shape[-1])

    def transposed(residual: Tensor) -> Tensor:
        with torch.enable_grad():
            at = torch.zeros_like(start, requires_grad=True)
            return torch.autograd.grad((enlarge_flow(at, scale, size) * known * residual).sum(), at)[0]

    found = start
    left = transposed(flow - enlarge_flow(found, scale, size))
    direction, squared = left, left.square().sum()
    goal = ENOUGH * squared
    for _ in range(ITERATIONS):
        if squared <= goal:
            break
        image = transposed(enlarge_flow(direction, scale, size))
        step = squared / (direction * image).sum()
        found, left = found + step * direction, left - step * image
        before, squared = squared, left.square().sum()
        direction = left + squared / before * direction
    return found


def wins(dataset: PairDataset, preset: str, assignments: Sequence[str]) -> torch.Tensor:
    """(scales, 3): number of pairs whose true flow beats itself times each factor.

    Prints each pair that fails at a scale which the preset judges.
    """
    loss = train_config(preset, assignments).loss
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
            alone = loss.model_copy(
                update={"lambda_s": tuple(float(s == scale) for s in range(scales)), "smoothness_s": None}
            )
            values = [self_supervised_loss([f * v for v in flows], image1, image2, alone)[0] for f in (1.0, *FACTORS)]
            won = torch.stack([values[0] < value for value in values[1:]])
            counts[scale] += won
            if loss.lambda_s[scale] and not won.all():
                better = [factor for factor, one in zip(FACTORS, won, strict=True) if not one]
                motion = (flow.norm(dim=1, keepdim=True) * known).sum() / known.sum()
                record = dataset.records[index]
                print(f"{preset}, s = {scale}: {record.name}, {record.scene}: {motion:.2f} px, {better} fit better")
    return counts


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--presets", default="paper,selfflow,best,real")
    parser.add_argument("--set", action="append", default=[], help="of the presets, such as loss.alpha=0.85")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    dataset = open_all(arguments.datasets)
    dataset = PairDataset(dataset.source, dataset.records[:: arguments.every])
    counts = {preset: wins(dataset, preset, arguments.set) for preset in arguments.presets.split(",")}
    scales = max(len(count) for count in counts.values())
    rows = [[preset, *(" / ".join(f"{one:.0f}" for one in line) for line in count)] for preset, count in counts.items()]
    print(f"{len(dataset)} pairs; those whose true flow beats no flow / 0.9 times / 1.1 times itself")
    print(markdown((["losses", *(f"s = {scale}" for scale in range(scales))], rows)))


if __name__ == "__main__":
    main()
