"""How certain a registered flow is, and the window that fits each place; on every fourth pixel of the image.

As `gelflow.models.evidence`, `gelflow.models.wider_window` and `gelflow.models.uncertainty`, which hold the equations,
with two differences. What the flow misses is the Gauss-Newton step that is left. Where the flow leaves more than
`UNEXPLAINED` of what unrelated images would, and more than the camera's noise, it has lost the pattern. Specks in the
optics are not looked for.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from gelflow.arrays import Estimate, FlowArray, MapArray
from gelflow.fast.registration import (
    CELL,
    CONFIG,
    TINY,
    Prepared,
    fields,
    gaussian,
    indices,
    inside,
    products,
    resized,
    slopes,
    unexplained,
    window_sums,
)
from gelflow.models.evidence import MAX_VARIANCE
from gelflow.models.uncertainty import CURVATURE, MAX_SIGMA_PX, RADIUS, UNKNOWN_PX
from gelflow.models.wider_window import FLAT, MIN_VARIANCE, TWO_STEPS, WIDTHS_PX, noise_shares

UNEXPLAINED = 0.6
"""Share of the residual of unrelated images above which a flow explains nothing; that of propagation."""
NEAR = 0.25
"""Weight of the neighbouring cells in the sum z of a window's pull; its square sum over the centre's is `_Z`."""
_Z = 1 + 2 * NEAR**2


class Refined(NamedTuple):
    """A flow (h, w, 2), px, on every fourth pixel, with sigma in px; whether it is lost there, (h, w)."""

    flow: FlowArray
    sigma: MapArray
    lost: NDArray[np.bool_]

    def estimate(self, image: Prepared) -> Estimate:
        """The same at each pixel of an image as it was given, in its px, with the probability to stay in it."""
        height, width = self.sigma.shape
        place, spread = CELL * (indices(height, width) + 0.5) + self.flow, self.sigma[..., None] / RADIUS
        last = np.array(image.size[::-1], np.float32)
        seen = (ndtr((last - place) / spread) - ndtr(-place / spread)).prod(axis=-1)
        sigma = image.on_image(self.sigma) * np.sqrt(image.scale.prod())
        flow, visible = image.on_image(self.flow) * image.scale, image.on_image(seen.astype(np.float32))
        return Estimate(flow, sigma.clip(max=MAX_SIGMA_PX), visible)


def refined(flow: FlowArray, first: Prepared, second: Prepared) -> Refined:
    """At each place the flow of the window that fits it, from one that `register` found, and how certain that is."""
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
    # The sum under w^2 is about half of that under w.
    halves = [product / (2 * _Z) for product in (zx * zx, zx * zy, zy * zy)]
    grid = (one.grid[0] // 2, one.grid[1] // 2)
    cells = 4 * resized(cv2.merge([*texture, *halves, *cv2.split(pull)]), grid)
    xx, xy, yy, zxx, zxy, zyy, xr, yr = cv2.split(window_sums(cells, narrow_px / CELL))
    determinant, trace = xx * yy - xy * xy, xx + yy
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = zxx * (yy**2 + xy**2) - 2 * zxy * xy * trace + zyy * (xx**2 + xy**2)
        variance = TWO_STEPS * variance / determinant**2
        step = cv2.merge([xy * yr - yy * xr, xy * xr - xx * yr]) / determinant[..., None]
    enough = (determinant > 0) & (trace > 0) & (variance >= 0) & (variance < MAX_VARIANCE)
    variance = np.where(enough, variance, MAX_VARIANCE).clip(MIN_VARIANCE)
    missed = np.where(enough, (step**2).sum(axis=-1), 0.0)
    known = variance < UNKNOWN_PX**2
    flow = resized(flow, grid)
    posterior = 1 / (1 / variance + 1 / (2 * CONFIG.prior_px**2))
    best, error = _best_window(flow, posterior.astype(np.float32), trace)
    error = np.where(known, error, variance) + missed
    gradient = cells[..., 0] + cells[..., 2]
    moment = np.where(known, _second_moment(gradient, narrow_px / CELL) / trace.clip(TINY), 0.0)
    marks = ((variance < 2 * CONFIG.prior_px**2) / variance).astype(np.float32)
    weight, errors = cv2.split(window_sums(cv2.merge([marks, (marks * error).astype(np.float32)]), wide_px / CELL))
    between = ~known & (weight > TINY)
    error = np.where(between, errors / weight.clip(TINY), error)
    moment = np.where(between, _second_moment(marks, wide_px / CELL) / weight.clip(TINY), moment)
    square = RADIUS**2 / 2 * (error + (CURVATURE * moment) ** 2 * _bend(best))
    left, share = (resized(each, grid) for each in unexplained(best, first, second, wide_px))
    lost = (share > UNEXPLAINED) & (left > (CONFIG.noise / 2) ** 2)
    sigma = np.where(lost, MAX_SIGMA_PX, np.sqrt(square.clip(0, MAX_SIGMA_PX**2)))
    return Refined(best, sigma.astype(np.float32), lost)


def _best_window(flow: FlowArray, variance: MapArray, texture: MapArray) -> tuple[FlowArray, MapArray]:
    """See `gelflow.models.wider_window.best_window`."""
    weight = texture.clip(0) + FLAT

    def mean(field: NDArray[np.float32], width: float) -> NDArray[np.float32]:
        sums = window_sums(np.dstack([weight, weight[..., None] * field]).astype(np.float32), width / CELL)
        return sums[..., 1:] / sums[..., :1]

    least, error, best = np.ones_like(variance), variance, flow
    for width in WIDTHS_PX:
        wide = mean(flow, width)
        wide = wide + mean(flow - wide, width)
        shared, left = noise_shares(CONFIG.windows_px[-1], width)
        apart = ((wide - flow) ** 2).sum(axis=-1) / variance
        risk = mean(apart[..., None], width)[..., 0] + 2 * shared - 1
        better = risk < least
        best, least = np.where(better[..., None], wide, best), np.where(better, risk, least)
        error = np.where(better, variance * risk.clip(left), error)
    return best, error


def _second_moment(field: MapArray, deviation: float) -> MapArray:
    """The sum of w(y - x) |y - x|^2 f(y), px^2 of the image."""
    plain, square = gaussian(deviation), gaussian(deviation, 2)
    sums = (
        cv2.sepFilter2D(field, -1, *kernels, borderType=cv2.BORDER_CONSTANT)
        for kernels in ((plain, square), (square, plain))
    )
    return CELL**2 * sum(sums)


def _bend(flow: FlowArray) -> MapArray:
    """|V''|^2 of the flow, px^-2."""
    second = [each for slope in slopes(flow, 1 / CELL) for each in slopes(slope, 1 / CELL)]
    return sum((each**2).sum(axis=-1) for each in second)
