"""Specks in the optics: dust, bubbles and scratches, which stand still while the gel around them moves.

They draw the flow to zero and bring the images together there, so that nothing near them tells. The motion P of a
pixel's surroundings does: a linear function of position, fitted to the flow of textured places in a ring around the
pixel. Outliers count less (iteratively reweighted least squares, Cauchy's weights), and so do places that may be specks
themselves: texture of image 1 that image 2 shows at the same pixels, where the flow says nothing better. Of those, a
speck is where P is not small, the flow is, and the images differ under P. Near specks, the flow errs by what it lacks
of P, and by the misfit s of P:

    e = |V - P|^2 + s^2.

A mark of the gel that stands still while all around it moves looks the same. A speck that covers a ring is not seen.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.models.evidence import TINY
from gelflow.models.propagation import windowed_residual
from gelflow.ops.gaussian import doubled, smoother, window_sums
from gelflow.ops.pyramid import resize_images
from gelflow.ops.warp import warp

CELL_PX, RING_CELLS, INNER_PX, WIDTH_PX = 6, 6, 10.0, 18.0
"""The ring: side of the cells to which the flow is reduced, half its side, its inner radius, and the standard deviation
of the Gaussian that weighs it."""
STRIDE = 2
"""Cells from one fit to the next, along each axis."""
NEAR_CELLS, COVER_PX = 2, 4
"""How far specks draw the flow, and how far beyond what is found of them they go."""
WINDOW_PX, MAX_RATIO = 2.0, 0.2
"""Window in which images are compared, and the largest ratio of squared differences where one of them is none."""
COVERED = 1.5, 0.35
"""The same where the flow is known to move at specks."""
MIN_GAIN = 0.03
"""What the flow must explain around specks, as a mean of (still - left) / (still + left)."""
MIN_CONTRAST, NOISE = 0.02, 0.002
"""Least contrast of a speck, and differences of images that are none; white is 1."""
DOUBT = 0.1
"""What a place that may be a speck counts in the fit of P."""
MIN_MOTION_PX, MISFITS, MAX_SHARE = 0.5, 2.0, 0.5
"""Least motion P, in px and in units of s, and the largest share of it that a speck leaves to the flow."""
FLOOR_PX, REWEIGHTINGS = 0.1, 6
"""Least misfit, and the number of fits."""


def speck_error(flow: Flow, image1: Images, image2: Images, texture: Tensor) -> Tensor:
    """E in px^2 near specks, else 0; (B, 1, H, W). `texture` is as of `Step`, 0 where it does not tell the flow."""
    stands, still, left = _standing(flow, image1, image2, WINDOW_PX, MAX_RATIO)
    stands &= still < 2 * left + NOISE**2
    texture, size = texture.clamp(min=0), (flow.shape[-2], flow.shape[-1])
    doubtful = F.interpolate(stands.float(), scale_factor=2.0)[..., : size[0], : size[1]] > 0
    motion, misfit = surroundings(flow, texture, torch.where(doubtful, DOUBT * texture, texture))
    moved = windowed_residual(motion, image1, image2, window_sums(flow, WINDOW_PX, 2), True)
    at_places = smoother(flow, 0.0, 2)
    fast, drawn = (at_places(each).square().sum(dim=1, keepdim=True) for each in (motion, flow))
    speck = stands & (fast > MIN_MOTION_PX**2 + MISFITS**2 * at_places(misfit)) & (drawn < MAX_SHARE**2 * fast)
    speck &= still < MAX_RATIO * moved
    near = F.max_pool2d(speck.float(), CELL_PX // 2, ceil_mode=True)
    near = F.max_pool2d(near, 2 * NEAR_CELLS + 1, 1, NEAR_CELLS)
    error = (flow - motion).square().sum(dim=1, keepdim=True) + misfit
    return resize_images(near, size) * error


def without_specks(flow: Flow, image1: Images, image2: Images) -> Images:
    """Image 1 with what a flow finds in image 2 in place of specks, which then no longer draw registration to zero.

    Here the flow itself moves at specks, as that of a network that was trained with them (`gelflow.training.specks`).
    They are texture that stands still and differs under the flow, where most texture around it obeys the flow.
    """
    with torch.no_grad(), torch.autocast(flow.device.type, enabled=False):
        flow, image1, image2 = flow.float(), image1.float(), image2.float()
        stands, still, left = _standing(flow, image1, image2, *COVERED)
        left = torch.where(left.isfinite(), left, still)  # nothing is known of what leaves the image
        moves = smoother(flow, 0.0, 2)(flow).square().sum(dim=1, keepdim=True) > MIN_MOTION_PX**2
        speck = stands & moves & (still < COVERED[1] * left)
        if not flow.is_cuda and not speck.any():  # a recorded CUDA graph cannot choose
            return image1
        reach = F.max_pool2d(speck.float(), COVER_PX + 1, 1, COVER_PX // 2)
        gain = torch.where(reach > 0, 0.0, (still - left) / (still + left + MIN_CONTRAST**2))
        obeyed = window_sums(gain, WIDTH_PX / 2)(gain - MIN_GAIN) > 0
        covered = doubled(reach * obeyed)[..., : flow.shape[-2], : flow.shape[-1]] > 0
        return torch.where(covered, warp(image2, flow), image1)


def _standing(
    flow: Flow, image1: Images, image2: Images, window_px: float, ratio: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Where texture stands still, up to that ratio, and the images' differences without motion and under the flow.

    They are squared, means under a window, at every second px, (B, 1, h, w).
    """
    window = window_sums(flow, window_px, 2)
    still, left = (windowed_residual(each, image1, image2, window, True) for each in (None, flow))
    contrast = windowed_residual(None, image1, torch.zeros_like(image2), window, True)
    return (still < ratio * contrast) & (contrast > MIN_CONTRAST**2), still, left


def surroundings(flow: Flow, texture: Tensor, trusted: Tensor) -> tuple[Flow, Tensor]:
    """P (B, 2, H, W), px, and s^2 (B, 1, H, W), px^2; `trusted` is the part of the texture that counts."""
    height, width = flow.shape[-2:]
    cells = F.avg_pool2d(torch.cat([texture, trusted, flow], dim=1), CELL_PX, ceil_mode=True)
    weight = cells[:, 1:2] / (cells[:, :1] + cells[:, :1].mean(dim=(2, 3), keepdim=True) + TINY)
    steps = CELL_PX * torch.arange(-RING_CELLS, RING_CELLS + 1, device=flow.device, dtype=flow.dtype)
    down, right = (step.flatten() for step in torch.meshgrid(steps, steps, indexing="ij"))
    square = down.square() + right.square()
    ring = torch.where(square > INNER_PX**2, torch.exp(-square / (2 * WIDTH_PX**2)), 0.0)
    around = F.unfold(torch.cat([weight, cells[:, 2:]], dim=1), len(steps), padding=RING_CELLS, stride=STRIDE)
    weight, flows = around.unflatten(1, (3, -1)).transpose(2, 3).split([1, 2], dim=1)  # (B, C, N, K)
    base = (weight + TINY) * ring
    design = torch.stack([torch.ones_like(down), right / WIDTH_PX, down / WIDTH_PX], dim=1)  # (K, 3)
    products = (design[:, :, None] * design[:, None]).flatten(1)
    weights, ridge = base, TINY * torch.eye(3, device=flow.device)
    for _ in range(REWEIGHTINGS):
        total = weights.sum(dim=3, keepdim=True)
        normal = (weights @ products / total).unflatten(3, (3, 3)) + ridge
        # By cofactors: a recording cannot ask whether `torch.linalg.solve` succeeded.
        a, b, c = normal.unbind(dim=-1)
        inverse = torch.stack([b.cross(c, dim=-1), c.cross(a, dim=-1), a.cross(b, dim=-1)], dim=-2)
        inverse = inverse / (a * inverse[..., 0, :]).sum(dim=-1)[..., None, None]
        found = (inverse @ (weights * flows @ design / total)[..., None])[..., 0]  # (B, 2, N, 3)
        apart = (flows - found @ design.T).square().sum(dim=1, keepdim=True)
        misfit = (weights * apart).sum(dim=3, keepdim=True) / total + FLOOR_PX**2
        weights = base / (1 + apart / misfit)
    # In the middle of STRIDE x STRIDE cells, of which the first has been fitted.
    middle = found[..., 0] + CELL_PX * (STRIDE - 1) / 2 / WIDTH_PX * found[..., 1:].sum(dim=3)
    grid = [math.ceil(side / STRIDE) for side in cells.shape[-2:]]
    maps = torch.cat([middle, misfit[..., 0]], dim=1).unflatten(2, grid)
    motion, misfit = resize_images(maps, (height, width)).split([2, 1], dim=1)
    return motion, misfit
