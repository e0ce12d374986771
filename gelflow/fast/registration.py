"""Fast registration: the Gauss-Newton steps of `gelflow.models.registration` on one core, by OpenCV's filters.

The equations are the same. A flow is smoothed to U, and each pixel takes the correction d with

    sum_y w(y - x) |F2(y + U + d) - F1(y)|^2 / s^2 + |d|^2 / p^2  ->  min.

What differs saves time. Images lose their mean over a neighbourhood once, and not the residual at each step. Flow and
window sums are known at every second pixel of the images, and stages with wide windows see images of half the size.
Image 2 is enlarged once by Lanczos' kernel and read bilinearly there, which dampens a pattern without moving it. No
neighbour's flow is tried, and no trained denoiser follows: `gelflow.fast.start` tries several starts instead.
"""

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import FlowArray, Grey8, ImageArray, MapArray
from gelflow.config import RegistrationConfig
from gelflow.files.image import to_grey
from gelflow.models.working_size import working_sizes

CONFIG = RegistrationConfig()
CELL = 4
"""Sides of prepared images are multiples of it, so that flow lies at every fourth pixel of the image exactly."""
MAX_STEP_PX = 1.0
"""Limit on a Gauss-Newton step of each component."""
TINY = 1e-6


class Stage(NamedTuple):
    """Steps in one window: image px per px of the images that they see, and standard deviations in px of the image."""

    pixel: int
    window_px: float
    smoothing_px: float
    steps: int = CONFIG.iterations


STAGES = tuple(
    Stage(2 if window >= 8 else 1, window, smoothing)
    for window, smoothing in zip(CONFIG.windows_px, CONFIG.smoothing_px, strict=True)
)


class Level:
    """An image without its local mean, (h, w, 3), each of whose px is `pixel` px of the image wide."""

    def __init__(self, image: ImageArray, pixel: int) -> None:
        self.image = image
        self.pixel = pixel
        self.grid = (image.shape[0] // 2, image.shape[1] // 2)

    @functools.cached_property
    def enlarged(self) -> ImageArray:
        """The image at twice its size, whose pixel X is at (X - 1/2) / 2 of the image."""
        return resized(self.image, (2 * self.image.shape[0], 2 * self.image.shape[1]), cv2.INTER_LANCZOS4)


class Prepared:
    """What registration and its starts need of an image (H, W, 3) in [0, 1]: itself, its levels by px, and its luma.

    Images of more than `gelflow.models.working_size.LARGE` px are reduced, and all are continued beyond the right and
    lower border to multiples of `CELL`. From here on px are those of the reduced image.
    """

    def __init__(self, image: ImageArray) -> None:
        self.shape = (image.shape[0], image.shape[1])
        self.size = working_sizes(*self.shape)[-1]
        beyond = (0, -self.size[0] % CELL, 0, -self.size[1] % CELL)
        whole = cv2.copyMakeBorder(resized(image, self.size), *beyond, cv2.BORDER_REPLICATE)
        self.whole: ImageArray = whole
        self.grey: Grey8 = to_grey(whole)
        high = whole - cv2.GaussianBlur(whole, (0, 0), CONFIG.background_px or 0.0)
        half = resized(high, (high.shape[0] // 2, high.shape[1] // 2))
        self.levels = {1: Level(high, 1), 2: Level(half, 2)}

    def on_image(self, field: NDArray[np.float32]) -> NDArray[np.float32]:
        """A field on any grid of this image at each pixel of the image as it was given."""
        rows, columns = self.size
        return resized(resized(field, self.grey.shape)[:rows, :columns], self.shape)

    def on_levels(self, flow: FlowArray) -> FlowArray:
        """A flow at each pixel of the image as it was given, in its px, as a start of registration."""
        rows, columns = self.grey.shape
        beyond = (0, rows - self.size[0], 0, columns - self.size[1])
        return cv2.copyMakeBorder(resized(flow, self.size) / self.scale, *beyond, cv2.BORDER_REPLICATE)

    @property
    def scale(self) -> NDArray[np.float32]:
        """Px of the image as it was given in one px, along x and y."""
        return np.array([self.shape[1] / self.size[1], self.shape[0] / self.size[0]], np.float32)


def register(flow: FlowArray, first: Prepared, second: Prepared, stages: Sequence[Stage] = STAGES) -> FlowArray:
    """Corrects a flow, px, whose grid may be any part of the image's; on the grid of the last stage."""
    for pixel, window_px, smoothing_px, steps in stages:
        one, two = first.levels[pixel], second.levels[pixel]
        spacing = 2 * pixel
        flow = start = smoothed(resized(flow, one.grid), smoothing_px / spacing)
        for _ in range(steps):
            residual, across, down, _ = fields(flow, one, two)
            pairs = [(across, across), (across, down), (down, down), (across, residual), (down, residual)]
            counted = inside(flow, one)
            terms = [counted * term for term in products([*pairs, (residual, residual)], one.grid)]
            sums = window_sums(cv2.merge([*terms, counted]), window_px / spacing) * spacing**2
            flow = flow + np.clip(_posterior(sums, flow - start), -MAX_STEP_PX, MAX_STEP_PX)
    return flow


def _posterior(sums: NDArray[np.float32], so_far: FlowArray) -> FlowArray:
    """The Gauss-Newton step: the solution of a system of two equations at each pixel."""
    xx, xy, yy, xr, yr, rr, pixels = cv2.split(sums)
    weight = (rr / (3 * pixels).clip(TINY) + CONFIG.noise**2) / CONFIG.prior_px**2
    xx, yy = xx + weight, yy + weight
    u, v = -xr - weight * so_far[..., 0], -yr - weight * so_far[..., 1]
    return cv2.merge([yy * u - xy * v, xx * v - xy * u]) / (xx * yy - xy * xy)[..., None]


def fields(flow: FlowArray, first: Level, second: Level) -> tuple[ImageArray, ImageArray, ImageArray, ImageArray]:
    """Under a flow on the level's grid: residual, gradient along x and y of both images' mean, and image 2 moved."""
    height, width = first.image.shape[:2]
    places = cv2.scaleAdd(resized(flow, (height, width)), 2 / first.pixel, 2 * indices(height, width) + 0.5)
    moved = cv2.remap(second.enlarged, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    # The mean of both images' gradients converges from further away than either alone.
    across, down = slopes(moved + first.image, 0.5 / first.pixel)
    return moved - first.image, across, down, moved


def slopes(image: NDArray[np.float32], factor: float = 1.0) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Central differences along x and y, times a factor."""
    across, down = (cv2.Sobel(image, -1, *axis, ksize=1, scale=factor / 2) for axis in ((1, 0), (0, 1)))
    return across, down


def products(pairs: Sequence[tuple[ImageArray, ImageArray]], grid: tuple[int, int]) -> list[MapArray]:
    """Products of images, summed over the colours, as means over the cells of a grid."""
    ones = np.ones((1, 3), np.float32)
    return [resized(cv2.transform(one * other, ones), grid) for one, other in pairs]


def inside(flow: FlowArray, level: Level) -> MapArray:
    """1 where the flow, on the level's grid, stays in the image, else 0; (h, w)."""
    height, width = flow.shape[:2]
    places = cv2.scaleAdd(flow, 0.5 / level.pixel, indices(height, width))
    return cv2.inRange(places, (-0.5, -0.5), (width - 0.5, height - 0.5)).astype(np.float32) / 255


def unexplained(flow: FlowArray, first: Prepared, second: Prepared, window_px: float) -> tuple[MapArray, MapArray]:
    """The mean square E of a flow's residual in a window, and its share of what unrelated images leave; (h, w) each.

    On the grid of the images of half the size. That share is E / (Var F1 + Var F2), 1 where nothing is left to compare.
    """
    one, two = first.levels[2], second.levels[2]
    flow = resized(flow, one.grid)
    residual, _, _, moved = fields(flow, one, two)
    counted = inside(flow, one)
    pairs = [(residual, residual), (one.image, one.image), (moved, moved)]
    terms = [counted * term / 3 for term in products(pairs, one.grid)]
    sums = window_sums(cv2.merge([*terms, counted]), window_px / 4)
    square, var1, var2, weight = cv2.split(sums)
    share = np.where(weight > TINY, square / (var1 + var2 + TINY), 1.0)
    return square / weight.clip(TINY), share


def window_sums(field: NDArray[np.float32], deviation: float) -> NDArray[np.float32]:
    """Sums of each channel under a Gaussian of height one; nothing is added where the window leaves the grid.

    Wide windows are summed over cells of two by two and read bilinearly.
    """
    if deviation >= 4:
        height, width = field.shape[:2]
        cells = 4 * resized(field, (-(-height // 2), -(-width // 2)), cv2.INTER_AREA)
        return resized(window_sums(cells, deviation / 2), (height, width))
    kernel = gaussian(deviation)
    return cv2.sepFilter2D(field, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT)


def smoothed(flow: FlowArray, deviation: float) -> FlowArray:
    """Means under a Gaussian; beyond the border, fields go on turned about their border's pixel, as in `smoother`."""
    kernel = gaussian(deviation) / gaussian(deviation).sum()
    beyond = len(kernel) // 2
    edge, mirrored = (
        cv2.copyMakeBorder(flow, *(beyond,) * 4, border) for border in (cv2.BORDER_REPLICATE, cv2.BORDER_REFLECT_101)
    )
    turned = 2 * edge - mirrored
    turned[beyond:-beyond, beyond:-beyond] = flow
    return cv2.sepFilter2D(turned, -1, kernel, kernel)[beyond:-beyond, beyond:-beyond]


def resized(field: NDArray[np.float32], grid: tuple[int, int], how: int | None = None) -> NDArray[np.float32]:
    """A field at another size, by default averaged where that is smaller and bilinear where it is larger."""
    if field.shape[:2] == grid:
        return field
    smaller = cv2.INTER_AREA if field.shape[0] > grid[0] else cv2.INTER_LINEAR
    return cv2.resize(field, (grid[1], grid[0]), interpolation=smaller if how is None else how)


@functools.cache
def gaussian(deviation: float) -> NDArray[np.float32]:
    """exp(-x^2 / 2 s^2) at whole x up to three deviations."""
    x = np.arange(-math.ceil(3 * deviation), math.ceil(3 * deviation) + 1)
    return np.exp(-(x**2) / (2 * deviation**2)).astype(np.float32)


@functools.lru_cache(8)
def indices(height: int, width: int) -> FlowArray:
    """Column and row of each pixel, (h, w, 2)."""
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([columns, rows], axis=-1)
