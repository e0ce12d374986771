"""Elastic refinement: the network's flow, corrected by what still differs between the images; nothing is learned.

The correction is a cubic B-spline W = B c on a grid of control points. From coarse grids to fine, Gauss-Newton
minimises

    E(c) = sum_x q(x) |F2(x + V(x) + W(x)) - F1(x)|^2 + stiffness S^2 sum_x |D^2 W(x)|^2

with the weight ``q = e / sqrt(|r|^2 + e^2)`` of the residual before each step (a robust norm of softness e), the linear
system being solved by conjugate gradients. Pixels that leave the image do not count. What is compared:

    F = [ brightness I,  structure (I - G I) / sqrt(G I^2 - (G I)^2 + 0.05^2) ],   G a Gaussian of 2.5 px.

The second part is indifferent to smooth changes of illumination. The first is not: with it, the flow follows shading as
if it were painted on the gel, which brings image 2 closer to image 1 and the flow further from the gel's motion. It
stays in the basin that the network found: dots that were taken for their neighbours stay so.

Lucas and Kanade 1981; Rueckert et al., "Nonrigid registration using free-form deformations", 1999.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features, Flow, Images
from gelflow.config import ElasticConfig
from gelflow.ops.bspline import SplineGrid
from gelflow.ops.warp import inside, warp

NEIGHBOURHOOD_PX = 2.5
"""Standard deviation of G."""
CONTRAST = 0.05
"""Local contrast below which structure counts as noise, of a white of 1."""
SOFTNESS = 0.1
"""e: residuals above this, 25 of 255 grey levels, count less and less."""
LARGEST_STEP_PX = 3.0
"""Limit on each control point's change within one Gauss-Newton step."""
SOLVER_STEPS = 12
"""Iterations of the conjugate gradients: the outer iteration corrects what they leave."""


def refined(flow: Flow, image1: Images, image2: Images, config: ElasticConfig) -> Flow:
    """Corrects a flow.

    Args:
        flow: (B, 2, H, W), px.
        image1: (B, 3, H, W) in [0, 1], on the same device.
        image2: The same shape.
        config: Grids and weights.

    Returns:
        The corrected flow, same shape. Each pair of a batch is treated on its own.
    """
    with torch.no_grad():
        first, second = compared(image1, config), compared(image2, config)
        for spacing in config.spacings:
            grid = SplineGrid(flow.shape[-2], flow.shape[-1], spacing, flow)
            points = flow.new_zeros(flow.shape[0], 2, *grid.shape)
            for _ in range(config.iterations):
                points = points + _step(grid, points, flow + grid.field(points), first, second, config.stiffness)
            flow = flow + grid.field(points)
    return flow


def compared(image: Images, config: ElasticConfig) -> Features:
    """F of an image (B, 3, H, W): three channels for each part of a weight above zero."""
    parts = []
    if config.brightness > 0:
        parts.append(config.brightness * image)
    if config.structure > 0:
        mean = gaussian(image)
        variance = (gaussian(image.square()) - mean.square()).clamp(min=0)
        parts.append(config.structure * (image - mean) / torch.sqrt(variance + CONTRAST**2))
    return torch.cat(parts, dim=1)


def gaussian(image: Images) -> Images:
    """The image (B, C, H, W) under G, its border repeated outside."""
    radius = round(3 * NEIGHBOURHOOD_PX)
    place = torch.arange(-radius, radius + 1, dtype=image.dtype, device=image.device)
    kernel = torch.exp(-place.square() / (2 * NEIGHBOURHOOD_PX**2))
    kernel = (kernel / kernel.sum()).view(1, 1, 1, -1)
    batch, channels, height, width = image.shape
    padded = F.pad(image, (radius,) * 4, mode="replicate").view(batch * channels, 1, height + 2 * radius, -1)
    return F.conv2d(F.conv2d(padded, kernel), kernel.transpose(2, 3)).view(batch, channels, height, width)


def _step(grid: SplineGrid, points: Tensor, flow: Flow, first: Features, second: Features, stiffness: float) -> Tensor:
    """One Gauss-Newton step of the control points at a flow that contains their field."""
    moved = warp(second, flow)
    residual = moved - first
    # The mean of both images' gradients converges from further away than either alone.
    across, down = ((a + b) / 2 for a, b in zip(_gradient(moved), _gradient(first), strict=True))
    weight = SOFTNESS / torch.sqrt(residual.square().mean(dim=1, keepdim=True) + SOFTNESS**2) * inside(flow)

    def mean(product: Tensor) -> Tensor:
        return weight * product.mean(dim=1, keepdim=True)

    xx, xy, yy = mean(across * across), mean(across * down), mean(down * down)
    slope = torch.cat([mean(across * residual), mean(down * residual)], dim=1)

    def curvature(change: Tensor) -> Tensor:
        u, v = grid.field(change).split(1, dim=1)
        data = grid.adjoint(torch.cat([xx * u + xy * v, xy * u + yy * v], dim=1))
        return data + stiffness * grid.bending(change) + 1e-8 * change

    diagonal = grid.diagonal(torch.cat([xx, yy], dim=1)) + stiffness * grid.bending_diagonal + 1e-6
    downhill = -(grid.adjoint(slope) + stiffness * grid.bending(points))
    return _solved(curvature, downhill, diagonal).clamp(-LARGEST_STEP_PX, LARGEST_STEP_PX)


def _gradient(image: Features) -> tuple[Features, Features]:
    """Central differences with the border repeated: d/dx and d/dy of (B, C, H, W), same shape."""
    padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
    across = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
    return across, (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2


def _solved(matrix: Callable[[Tensor], Tensor], right: Tensor, diagonal: Tensor) -> Tensor:
    """Conjugate gradients with a diagonal preconditioner, each pair of the batch with its own step lengths."""

    def dot(one: Tensor, other: Tensor) -> Tensor:
        return (one * other).sum(dim=(1, 2, 3), keepdim=True)

    tiny = torch.finfo(right.dtype).tiny
    solution, residual = torch.zeros_like(right), right
    direction = residual / diagonal
    product = dot(residual, direction)
    for _ in range(SOLVER_STEPS):
        image = matrix(direction)
        length = product / dot(direction, image).clamp(min=tiny)
        solution, residual = solution + length * direction, residual - length * image
        scaled = residual / diagonal
        former, product = product, dot(residual, scaled)
        direction = scaled + product / former.clamp(min=tiny) * direction
    return solution
