"""The RAFT network (Teed, Deng: RAFT: Recurrent All-Pairs Field Transforms for Optical Flow, ECCV 2020).

Features of both images and context of the first at an eighth of the resolution, all-pairs correlation, then a number
of recurrent updates of the flow, which starts at zero. The result is brought to full resolution bilinearly (small
network: corner pixels map to corner pixels, as its weights were trained) or as a learned convex combination of 3x3
neighbours (large network).

What it cannot do: learn here; it runs published weights, for comparison. Memory grows with the square of the number
of pixels: a pair of 640 x 480 px holds 4800^2 correlations and their pyramid, 120 MB.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from gelflow.arrays import Flow, Images
from gelflow.models.gelflow import check_shapes
from gelflow.models.raft.correlation import LEVELS, correlation_pyramid, lookup
from gelflow.models.raft.encoder import RaftEncoder
from gelflow.models.raft.update import LARGE, SMALL, UpdateBlock
from gelflow.ops.warp import pixel_indices

STRIDE = 8
"""Resolution of the image over that of the features."""


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
        """Estimates the flow.

        Args:
            image1: (B, 3, H, W) float32 in [0, 1]; H, W >= 64; repeated at the border up to multiples of 8.
            image2: The same shape.

        Returns:
            (B, 2, H, W) float32, px.

        Raises:
            InputError: The images' shapes differ or are not (B, 3, H >= 64, W >= 64).
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
