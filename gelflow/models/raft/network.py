"""The RAFT network (Teed, Deng: RAFT: Recurrent All-Pairs Field Transforms for Optical Flow, ECCV 2020).

Features of both images and context of the first at an eighth of the resolution (section 3.1), all-pairs correlation
(section 3.2), then a number of recurrent updates of the flow, which starts at zero. The result is brought to full
resolution bilinearly (small network: corner pixels map to corner pixels, as its weights were trained) or as a learned
convex combination of 3x3 neighbours (large network). It runs published weights, for comparison; names of submodules are
theirs (`gelflow.models.raft.weights`). Memory grows with the square of the number of pixels: 120 MB for 640 x 480 px.

Correlation ``C(x, y) = <f1(x), f2(y)> / sqrt(channels)`` is taken at four resolutions of image 2: level k is the mean
over blocks of 2^k x 2^k pixels y. The lookup reads C(x, .) bilinearly on a grid of (2 r + 1)^2 unit steps of each level
around the point that x has moved to; outside the image it reads zero. Two conventions of the published weights differ
from the rest of gelflow:

- Positions are pixel *indices* at every level: index i of level 0 is read at index i / 2^k of level k, although the
  centre of its block lies at (i + 1/2) / 2^k - 1/2.
- Displacements are ordered column by column: channel (d_x + r)(2 r + 1) + (d_y + r).
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gelflow.arrays import Features, Flow, Images
from gelflow.models.gelflow import check_shapes
from gelflow.models.raft.update import LARGE, SMALL, UpdateBlock
from gelflow.ops.warp import pixel_indices

STRIDE = 8
"""Resolution of the image over that of the features."""
LEVELS = 4
"""Resolutions of the correlation."""


def correlation_pyramid(first: Features, second: Features) -> list[Tensor]:
    """All-pairs correlation at `LEVELS` resolutions of the second image, (B H W, 1, H // 2^k, W // 2^k) at level k.

    H and W are at least 8, so that every level has a pixel.
    """
    batch, channels, height, width = first.shape
    product = torch.einsum("bcn,bcm->bnm", first.flatten(2), second.flatten(2)) / channels**0.5
    levels = [product.reshape(batch * height * width, 1, height, width)]
    for _ in range(LEVELS - 1):
        levels.append(F.avg_pool2d(levels[-1], 2))
    return levels


def lookup(pyramid: list[Tensor], position: Flow, radius: int) -> Features:
    """Correlation around given positions, (B, LEVELS (2 r + 1)^2, H, W), finest level first.

    The pyramid is as `correlation_pyramid` gives it; positions are where each pixel of image 1 is in image 2, (B, 2, H,
    W), (column, row) as indices; the radius is r, px of each level.
    """
    batch, _, height, width = position.shape
    side = 2 * radius + 1
    step = torch.arange(-radius, radius + 1, dtype=position.dtype, device=position.device)
    across, down = torch.meshgrid(step, step, indexing="ij")
    window = torch.stack([across, down], dim=-1)
    centre = position.permute(0, 2, 3, 1).reshape(batch * height * width, 1, 1, 2)
    found = []
    for level, costs in enumerate(pyramid):
        size = costs.new_tensor([costs.shape[-1], costs.shape[-2]])
        # An index i is at (2 i + 1) / size - 1 in grid_sample's coordinates, with align_corners=False.
        place = (2 * (centre / 2**level + window) + 1) / size - 1
        values = F.grid_sample(costs, place, mode="bilinear", padding_mode="zeros", align_corners=False)
        found.append(values.view(batch, height, width, side * side))
    return torch.cat(found, dim=-1).permute(0, 3, 1, 2).contiguous()


Norm = Callable[[int], nn.Module]
"""Normalisation of so many channels: over each channel of a sample, by the weights' own statistics, or none."""


class ResidualUnit(nn.Module):
    """Two 3x3 convolutions, or a 3x3 one of a quarter of the channels between two of 1x1, beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, norm: Norm, bottleneck: bool) -> None:
        super().__init__()
        inner = outputs // 4
        layers = [(inputs, outputs, 3, stride), (outputs, outputs, 3, 1)]  # channels in and out, kernel, stride
        if bottleneck:
            layers = [(inputs, inner, 1, 1), (inner, inner, 3, stride), (inner, outputs, 1, 1)]
        self.depth = len(layers)
        for number, (before, after, side, step) in enumerate(layers, start=1):
            self.add_module(f"conv{number}", nn.Conv2d(before, after, side, stride=step, padding=side // 2))
            self.add_module(f"norm{number}", norm(after))
        self.downsample = nn.Sequential()
        if stride > 1:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride=stride), norm(outputs))

    def forward(self, state: Features) -> Tensor:
        """Features (B, outputs, H / stride, W / stride)."""
        change = state
        for number in range(1, self.depth + 1):
            change = self.get_submodule(f"norm{number}")(self.get_submodule(f"conv{number}")(change)).relu()
        shortcut: Tensor = self.downsample(state)
        return (shortcut + change).relu()


class RaftEncoder(nn.Module):
    """Features of images at an eighth of their resolution; `stages` are the channels of its three stages."""

    def __init__(self, stages: tuple[int, int, int], outputs: int, norm: Norm, bottleneck: bool) -> None:
        super().__init__()

        def stage(inputs: int, channels: int, stride: int) -> nn.Module:
            first = ResidualUnit(inputs, channels, stride, norm, bottleneck)
            return nn.Sequential(first, ResidualUnit(channels, channels, 1, norm, bottleneck))

        first, second, third = stages
        self.conv1 = nn.Conv2d(3, first, 7, stride=2, padding=3)
        self.norm1 = norm(first)
        self.layer1 = stage(first, first, 1)
        self.layer2 = stage(first, second, 2)
        self.layer3 = stage(second, third, 2)
        self.conv2 = nn.Conv2d(third, outputs, 1)

    def forward(self, images: Images) -> Features:
        """Features (B, outputs, H / 8, W / 8) of images (B, 3, H, W) in [-1, 1], H and W multiples of 8."""
        state = self.norm1(self.conv1(images)).relu()
        features: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(state))))
        return features


class RAFT(nn.Module):
    """Flow from image 1 to image 2.

    The large one has 5.3 million weights, the small one 1.0 million; `iterations` is the number of recurrent updates.
    """

    def __init__(self, *, large: bool, iterations: int = 20) -> None:
        super().__init__()
        self.sizes = LARGE if large else SMALL
        self.large = large
        self.iterations = iterations
        stages, outputs = self.sizes.stages, self.sizes.hidden + self.sizes.context
        self.fnet = RaftEncoder(stages, self.sizes.features, nn.InstanceNorm2d, bottleneck=not large)
        norm = nn.BatchNorm2d if large else lambda _: nn.Sequential()
        self.cnet = RaftEncoder(stages, outputs, norm, bottleneck=not large)
        costs = LEVELS * (2 * self.sizes.radius + 1) ** 2
        self.update_block = UpdateBlock(self.sizes, costs, large=large)

    def forward(self, image1: Images, image2: Images) -> Flow:
        """The flow (B, 2, H, W) float32, px, of images (B, 3, H, W) float32 in [0, 1]; H, W >= 64, else InputError.

        Images are repeated at the border up to multiples of 8.
        """
        check_shapes(image1, image2)
        height, width = image1.shape[-2:]
        across, down = -width % STRIDE, -height % STRIDE
        left, top = across // 2, down // 2
        padding = (left, across - left, top, down - top)
        first, second = (F.pad(2 * image - 1, padding, mode="replicate") for image in (image1, image2))
        flow = self._iterate(first, second)
        return flow[..., top : top + height, left : left + width].contiguous()

    def _iterate(self, first: Images, second: Images) -> Flow:
        features1, features2 = self.fnet(first).float(), self.fnet(second).float()
        pyramid = correlation_pyramid(features1, features2)
        hidden, context = self.cnet(first).split([self.sizes.hidden, self.sizes.context], dim=1)
        hidden, context = hidden.tanh(), context.relu()
        start = pixel_indices(features1).expand(len(features1), -1, -1, -1)
        position, weights = start, None
        for _ in range(self.iterations):
            position = position.detach()
            costs = lookup(pyramid, position, self.sizes.radius)
            hidden, change, weights = self.update_block(hidden, context, costs, position - start)
            position = position + change.float()
        flow = position - start
        return enlarge_bilinear(flow) if weights is None else enlarge_convex(flow, weights)


def enlarge_bilinear(flow: Flow) -> Flow:
    """The flow at full resolution, corner pixel to corner pixel: (B, 2, H, W) to (B, 2, 8 H, 8 W)."""
    size = (STRIDE * flow.shape[-2], STRIDE * flow.shape[-1])
    return STRIDE * F.interpolate(flow, size=size, mode="bilinear", align_corners=True)


def enlarge_convex(flow: Flow, weights: Tensor) -> Flow:
    """The flow at full resolution, each pixel a mean of its 3x3 coarse neighbours with its own weights.

    The weights (B, 9 64, H, W) are logarithms: neighbour, then row and column within the 8x8 block.
    """
    batch, _, height, width = flow.shape
    shares = weights.view(batch, 1, 9, STRIDE, STRIDE, height, width).softmax(dim=2)
    neighbours = F.unfold(STRIDE * flow, 3, padding=1).view(batch, 2, 9, 1, 1, height, width)
    fine = (shares * neighbours).sum(dim=2)
    return fine.permute(0, 1, 4, 2, 5, 3).reshape(batch, 2, STRIDE * height, STRIDE * width)
