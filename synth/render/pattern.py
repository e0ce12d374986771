"""The coating's reflectance as a texture over the contact face, in material coordinates.

The texture is a picture of the undeformed contact face as the camera sees it: column 0 begins at x = -size_x / 2, row 0
at y = -size_y / 2 (x right, y down), and the centre of texel (row r, column c) lies at

    x = ((c + 0.5) / columns - 0.5) · size_x,   y = ((r + 0.5) / rows - 0.5) · size_y.

Edges are at least one texel wide, so that the texture holds no detail beyond its own resolution.
"""

import math
from functools import singledispatch

import numpy as np

from synth.arrays import FloatArray, Image
from synth.errors import InputError
from synth.optics import Optics
from synth.scene import Dots, NoPattern, RandomColor, Sensor, Speckle

TEXELS_PER_PIXEL = 4
"""Texels per image pixel and axis on the undeformed contact face: bilinear lookup stays below the pixel's own blur."""
_STEP_MM = 0.01
MAX_TEXELS = 3072
"""Per axis; a finer pattern than this would not fit on many GPUs."""


def albedo(sensor: Sensor, rng: np.random.Generator) -> Image:
    """Reflectance over the contact face (see the module for the mapping).

    Args:
        sensor: pad size, coating, pattern, and the camera, which sets the resolution.
        rng: draws the pattern.

    Returns:
        (rows, columns, 3) float32 in [0, 1]; linear.
    """
    width, height = sensor.gel.size_mm[:2]
    density = TEXELS_PER_PIXEL * pixels_per_mm(sensor)
    density = min(density, MAX_TEXELS / max(width, height))
    columns, rows = max(4, math.ceil(width * density)), max(4, math.ceil(height * density))
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * width
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * height
    coating = np.array(sensor.coating.reflectance)
    return np.clip(_paint(sensor.pattern, x, y, coating, rng), 0, 1).astype(np.float32)


def pixels_per_mm(sensor: Sensor) -> float:
    """Image scale on the undeformed contact face: the finest of all cameras and directions.

    It is taken at the pad's middle; for a camera that does not see that, where a grid of its pixels meets the pad.

    Raises:
        InputError: no camera sees the pad.
    """
    finest = max(_scale(Optics.of(view), view) for view in sensor.views.values())
    if finest == 0:
        raise InputError("no camera sees the gel pad: check sensor.camera's position_mm, look_at_mm and the mirrors")
    return round(finest, 6)


def _scale(optics: Optics, sensor: Sensor) -> float:
    """Largest stretch of the map from the contact face to pixels, in px per mm; 0 where nothing is seen."""
    pixels = optics.project(np.zeros((1, 3)))
    if not optics.is_inside(pixels).all():
        edges = (np.linspace(0, side, 13) for side in (sensor.camera.width, sensor.camera.height))
        pixels = np.column_stack([axis.ravel() for axis in np.meshgrid(*edges)])
    rays = optics.look(pixels)
    points = rays.origins - rays.directions * (rays.origins[:, 2:] / rays.directions[:, 2:])
    with np.errstate(invalid="ignore"):
        seen = np.all(np.abs(points[:, :2]) <= np.array(sensor.gel.size_mm[:2]) / 2, axis=1)
    if not seen.any():
        return 0.0
    points, path = points[seen], rays.path[seen]
    moved = [
        (optics.project(points + arm, path) - optics.project(points - arm, path)) / (2 * _STEP_MM)
        for arm in _STEP_MM * np.eye(3)[:2]
    ]
    jacobian = np.stack(moved, axis=2)
    jacobian = jacobian[np.isfinite(jacobian).all(axis=(1, 2))]  # at the edge of a lens's field a step may leave it
    return float(np.linalg.svd(jacobian, compute_uv=False)[:, 0].max(initial=0.0))


def is_grey(sensor: Sensor) -> bool:
    """Whether coating, pattern and lights are all grey, so that one channel tells everything."""
    pattern = sensor.pattern
    if isinstance(pattern, RandomColor) and pattern.saturation > 0:
        return False
    colors = [sensor.coating.reflectance, *(light.color for light in sensor.lights)]
    if isinstance(pattern, Dots | Speckle):
        colors.append(pattern.reflectance)
    return all(color[0] == color[1] == color[2] for color in colors)


@singledispatch
def _paint(pattern: object, x: FloatArray, y: FloatArray, coating: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(rows, columns, 3) reflectance at texel centres x (columns,) and y (rows,), mm."""
    raise TypeError(f"no way to paint {type(pattern).__name__}")


@_paint.register
def _bare(
    pattern: NoPattern, x: FloatArray, y: FloatArray, coating: FloatArray, rng: np.random.Generator
) -> FloatArray:
    return np.broadcast_to(coating, (len(y), len(x), 3)).copy()


@_paint.register
def _dots(pattern: Dots, x: FloatArray, y: FloatArray, coating: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Disks on a jittered grid; coverage falls from 1 to 0 over `softness_mm` around the radius."""
    pitch = max(x[1] - x[0], y[1] - y[0])
    softness = max(pattern.softness_mm, pitch)
    coverage = np.zeros((len(y), len(x)))
    (sx, sy), (ox, oy) = pattern.spacing_mm, pattern.offset_mm
    c, s = math.cos(math.radians(pattern.rotation_deg)), math.sin(math.radians(pattern.rotation_deg))
    corners = [(u - ox, v - oy) for u in (x[0], x[-1]) for v in (y[0], y[-1])]
    along, across = [(u * c + v * s) / sx for u, v in corners], [(v * c - u * s) / sy for u, v in corners]
    for j in range(math.floor(min(across)), math.ceil(max(across)) + 1):
        for i in range(math.floor(min(along)), math.ceil(max(along)) + 1):
            dx, dy, grow = rng.standard_normal(3)
            cx = ox + i * sx * c - j * sy * s + pattern.jitter_mm * dx
            cy = oy + i * sx * s + j * sy * c + pattern.jitter_mm * dy
            radius = pattern.radius_mm * max(0.0, 1 + pattern.radius_jitter * grow)
            reach = radius + softness
            rows = slice(*np.searchsorted(y, [cy - reach, cy + reach]))
            columns = slice(*np.searchsorted(x, [cx - reach, cx + reach]))
            distance = np.hypot(x[None, columns] - cx, y[rows, None] - cy)
            disk = np.clip((radius - distance) / softness + 0.5, 0, 1)
            coverage[rows, columns] = np.maximum(coverage[rows, columns], disk)
    return coating + coverage[:, :, None] * (np.array(pattern.reflectance) - coating)


@_paint.register
def _random_color(
    pattern: RandomColor, x: FloatArray, y: FloatArray, coating: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Square cells of random hue and value, each hue at least 1/8 turn from its left and upper neighbours'.

    The coating's reflectance scales the colours, so that a white cell reflects what the bare coating would.
    """
    cell = pattern.cell_mm
    columns = math.ceil((x[-1] - x[0]) / cell) + 2
    rows = math.ceil((y[-1] - y[0]) / cell) + 2
    hue = rng.random((rows, columns))
    for _ in range(20):
        clash = np.zeros((rows, columns), dtype=bool)
        clash[:, 1:] |= _hue_distance(hue[:, 1:], hue[:, :-1]) < 1 / 8
        clash[1:, :] |= _hue_distance(hue[1:, :], hue[:-1, :]) < 1 / 8
        if not clash.any():
            break
        hue[clash] = rng.random(int(clash.sum()))
    value = 0.35 + 0.65 * rng.random((rows, columns))
    saturation = pattern.saturation * (0.6 + 0.4 * rng.random((rows, columns)))
    phase = (hue[:, :, None] * 6 + np.array([5.0, 3.0, 1.0])) % 6
    colors = value[:, :, None] * (1 - saturation[:, :, None] * np.clip(np.minimum(phase, 4 - phase), 0, 1))
    offset = rng.random(2) * cell
    horizontal = _blend_matrix(x, x[0] - offset[0], cell, columns, pattern.softness_mm)
    vertical = _blend_matrix(y, y[0] - offset[1], cell, rows, pattern.softness_mm)
    return np.einsum("yr,rxk->yxk", vertical, np.einsum("xc,rck->rxk", horizontal, colors)) * coating


@_paint.register
def _speckle(
    pattern: Speckle, x: FloatArray, y: FloatArray, coating: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Smooth noise of correlation length `grain_mm`, cut at the level that leaves `coverage` of the area dark."""
    from scipy.ndimage import gaussian_filter

    pitch = (y[1] - y[0], x[1] - x[0])
    # Level sets of Gaussian-filtered noise have blobs of about 4 sigma across.
    sigma = [max(0.5, pattern.grain_mm / 4 / step) for step in pitch]
    noise = gaussian_filter(rng.standard_normal((len(y), len(x))), sigma, mode="wrap")
    noise /= noise.std()
    level = np.quantile(noise, 1 - pattern.coverage)
    # The noise's rms slope is 1 / (sqrt(2) sigma) per texel: this makes the edge about one texel wide.
    coverage = np.clip((noise - level) * math.sqrt(2) * min(sigma) + 0.5, 0, 1)
    return coating + coverage[:, :, None] * (np.array(pattern.reflectance) - coating)


def _hue_distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Distance on the colour circle, in turns."""
    difference = np.abs(a - b)
    return np.minimum(difference, 1 - difference)


def _blend_matrix(at: FloatArray, start: float, cell: float, count: int, softness: float) -> FloatArray:
    """(len(at), count) weights of cells of width `cell` from `start` on, blended over `softness` at their borders."""
    softness = min(max(softness, at[1] - at[0]), cell)
    edges = start + cell * np.arange(1, count)
    passed = np.clip((at[:, None] - edges) / softness + 0.5, 0, 1)
    ones, zeros = np.ones((len(at), 1)), np.zeros((len(at), 1))
    return np.hstack([ones, passed]) - np.hstack([passed, zeros])
