"""How certain a registered flow is, and the window that fits each place; on every fourth pixel of the image.

As `gelflow.models.evidence`, `gelflow.models.wider_window` and `gelflow.models.uncertainty`, which hold the equations,
with two differences. What the flow misses is the Gauss-Newton step that is left. Where the flow leaves more than
`UNEXPLAINED` of what unrelated images would, and more than the camera's noise, it has lost the pattern. Near specks in
the optics, sigma is raised (`gelflow.fast.specks`).

Dots taken for the next ones explain the images, all but at the edge of the place where they were taken. So the picture
is cut where images differ, where nothing is known, and where the flow strains the gel much, as between two dots of
which one jumped. Of its parts the largest is right; of the others nothing is known, because they may have jumped. In a
stream, what was known in the frame before stays known where it has hardly moved since.
"""

from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtr
from torch import Tensor

from gelflow.arrays import Estimate, FlowArray, ImageArray, MapArray
from gelflow.fast.registration import (
    CELL,
    CONFIG,
    Prepared,
    fields,
    indices,
    inside,
    products,
    resized,
    slopes,
    unexplained,
)
from gelflow.fast.specks import speck_error
from gelflow.fast.start import TORN
from gelflow.models.evidence import MAX_VARIANCE, solved
from gelflow.models.registration import posterior_variance
from gelflow.models.uncertainty import (
    CURVATURE,
    MAX_SIGMA_PX,
    RADIUS,
    UNKNOWN_PX,
    between_marks,
    curvature_square,
    second_moment,
)
from gelflow.models.wider_window import MIN_VARIANCE, TWO_STEPS, best_window
from gelflow.ops.gaussian import window_sums

UNEXPLAINED = 0.6
"""Share of the residual of unrelated images above which a flow explains nothing; that of propagation."""
DOUBTFUL, STRAINED = 0.2, 0.3
"""The same share, and the norm of Green's strain, at which the picture is cut."""
NO_JUMP_PX = 4.0
"""Motion from one frame to the next that is no jump."""
GAP = 3
"""Cells: narrower gaps in a cut are closed."""
NEAR = 0.25
"""Weight of the neighbouring cells in the sum z of a window's pull; its square sum over the centre's is `_Z`."""
_Z = 1 + 2 * NEAR**2


class Refined(NamedTuple):
    """A flow (h, w, 2), px, on every fourth pixel, with sigma in px; whether it is known and lost there, (h, w).

    `torn` is as of `gelflow.fast.start.torn`.
    """

    flow: FlowArray
    sigma: MapArray
    known: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    torn: float

    def estimate(self, image: Prepared) -> Estimate:
        """The same at each pixel of an image as it was given, in its px, with the probability to stay in it."""
        height, width = self.sigma.shape
        place, spread = CELL * (indices(height, width) + 0.5) + self.flow, self.sigma[..., None] / RADIUS
        last = np.array(image.size[::-1], np.float32)
        seen = (ndtr((last - place) / spread) - ndtr(-place / spread)).prod(axis=-1)
        sigma = image.on_image(self.sigma) * np.sqrt(image.scale.prod())
        flow, visible = image.on_image(self.flow) * image.scale, image.on_image(seen.astype(np.float32))
        return Estimate(flow, sigma.clip(max=MAX_SIGMA_PX), visible)


def refined(flow: FlowArray, first: Prepared, second: Prepared, before: Refined | None = None) -> Refined:
    """At each place the flow of the window that fits it, from one that `register` found, and how certain that is.

    `before` is that of the frame before `second`.
    """
    narrow_px, wide_px = CONFIG.windows_px[-1], CONFIG.windows_px[0]
    one = first.levels[1]
    residual, across, down, _ = fields(flow, one, second.levels[1])
    noise = slopes(residual, 0.5)
    squares = [(across, across), (across, down), (down, down)]
    noises = [(noise[0], noise[0]), (noise[0], noise[1]), (noise[1], noise[1])]
    found = products([*squares, *noises, (across, residual), (down, residual)], one.grid)
    counted = 4 * inside(flow, one)
    texture = [counted * (square - noise) for square, noise in zip(found[:3], found[3:6], strict=True)]
    pull = cv2.merge([counted * found[6], counted * found[7]])
    kernel = np.array([NEAR, 1, NEAR], np.float32)
    zx, zy = cv2.split(cv2.sepFilter2D(pull, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT))
    squares_of_z = [product / _Z for product in (zx * zx, zx * zy, zy * zy)]
    grid = (one.grid[0] // 2, one.grid[1] // 2)
    cells = _tensor(4 * resized(cv2.merge([*texture, *squares_of_z, *cv2.split(pull)]), grid))
    window, wide = (window_sums(cells, width / CELL) for width in (narrow_px, wide_px))
    gradient = cells[:, :1] + cells[:, 2:3]
    step, variance, _ = solved(window(cells))
    variance = (TWO_STEPS * variance).clamp(MIN_VARIANCE, MAX_VARIANCE)
    known, textured = variance < UNKNOWN_PX**2, window(gradient)
    posterior = posterior_variance(variance, CONFIG.prior_px)
    best, error = best_window(_tensor(resized(flow, grid)), posterior, textured, narrow_px, CELL)
    error = torch.where(known, error, variance) + step.square().sum(dim=1, keepdim=True)
    moment = torch.where(known, second_moment(window, gradient) / textured, 0.0)
    error, moment = between_marks(error, moment, variance, wide)
    square = RADIUS**2 / 2 * (error + (CURVATURE * CELL**2 * moment).square() * curvature_square(best, CELL))
    fitted, sigma = best[0].movedim(0, -1).contiguous().numpy(), square.clamp(max=MAX_SIGMA_PX**2).sqrt()[0, 0].numpy()
    trusted, lost, torn = _parts(fitted, sigma, first, second, before)
    specks = speck_error(fitted, torch.where(known, textured, 0.0)[0, 0].numpy(), first, second)
    sigma = np.sqrt(sigma**2 + RADIUS**2 / 2 * specks).clip(max=MAX_SIGMA_PX)
    return Refined(fitted, np.where(trusted, sigma, np.float32(MAX_SIGMA_PX)), trusted, lost, torn)


def doubted(flow: FlowArray, sigma: MapArray, image1: ImageArray, image2: ImageArray) -> MapArray:
    """Any method's sigma (H, W), px, raised to `MAX_SIGMA_PX` where its flow (H, W, 2), px, may have jumped."""
    first, second = Prepared(image1), Prepared(image2)
    grid = (first.grey.shape[0] // CELL, first.grey.shape[1] // CELL)
    on_cells, scale = resized(first.on_levels(np.nan_to_num(flow)), grid), np.sqrt(first.scale.prod())
    known, _, _ = _parts(on_cells, resized(sigma, grid) / scale, first, second)
    return np.where(first.on_image(known.astype(np.float32)) > 0.5, sigma, np.float32(MAX_SIGMA_PX))


def _parts(
    flow: FlowArray, sigma: MapArray, first: Prepared, second: Prepared, before: Refined | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], float]:
    """`Refined.known`, `lost` and `torn`."""
    wide = unexplained(flow, first, second, CONFIG.windows_px[0])
    left, share = (resized(each, sigma.shape) for each in wide)
    lost, differ = (share > UNEXPLAINED) & (left > (CONFIG.noise / 2) ** 2), left > CONFIG.noise**2
    cut = lost | (share > DOUBTFUL) & differ | (sigma > UNKNOWN_PX) | (_strain(flow) > STRAINED)
    inner = cv2.erode((~cut).astype(np.uint8), np.ones((GAP, GAP), np.uint8))
    count, parts, boxes, _ = cv2.connectedComponentsWithStats(inner, connectivity=4)
    known = parts == (1 + boxes[1:, cv2.CC_STAT_AREA].argmax() if count > 1 else -1)
    if before is not None:
        known |= (inner > 0) & before.known & (np.linalg.norm(flow - before.flow, axis=-1) < NO_JUMP_PX)
    return known, lost, float(((share > TORN) & differ).mean())


def _strain(flow: FlowArray) -> MapArray:
    """The norm of Green's strain (F^T F - 1) / 2 of a flow on cells, F = 1 + grad V; (h, w)."""
    down, across = np.gradient(flow, CELL, axis=(0, 1))
    (ux, vx), (uy, vy) = np.moveaxis(np.stack([across, down]), -1, 1)
    xx, yy, xy = ux + (ux * ux + vx * vx) / 2, vy + (uy * uy + vy * vy) / 2, (ux * uy + vx * vy + uy + vx) / 2
    return np.asarray(np.sqrt(xx * xx + yy * yy + 2 * xy * xy))


def _tensor(field: NDArray[np.float32]) -> Tensor:
    """(h, w, C) as (1, C, h, w)."""
    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(field, -1, 0)))[None]
