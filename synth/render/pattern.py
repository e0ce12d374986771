"""The coating's reflectance as a texture over the contact face, in material coordinates.

The texture is a picture of the undeformed contact face as the camera sees it: column 0 begins at x = -size_x / 2, row 0
at y = -size_y / 2 (x right, y down), and the centre of texel (row r, column c) lies at

    x = ((c + 0.5) / columns - 0.5) · size_x,   y = ((r + 0.5) / rows - 0.5) · size_y.

Marks that lie above a coating that shines come with their coverage: the renderer blends the two reflections
(`render.coating`). On a dome the texture is laid on along z; its resolution is that at the apex. Dots and speckle are
drawn in `synth.render.marks`, pictures of the user's own are laid on in `synth.render.bitmap`.
"""

import math
from pathlib import Path

import numpy as np

from synth.arrays import FloatArray, Image
from synth.errors import InputError
from synth.mesh import face_of
from synth.mesh.cad import CadFace
from synth.optics import Optics
from synth.render.bitmap import painted, read_picture
from synth.render.chart import RoundChart, chart_of
from synth.render.marks import dot_centres, marks_coverage
from synth.scene import Bitmap, Dots, NoPattern, RandomColor, Sensor, Speckle

TEXELS_PER_PIXEL = 4
"""Texels per image pixel and axis on the undeformed contact face: bilinear lookup stays below the pixel's own blur."""
_STEP_MM = 0.01
"""Step of the differences that give the image's scale."""
MAX_TEXELS = 3072
"""Per axis; a finer pattern than this would not fit on many GPUs."""
_STRIP = 32
"""Rows of the texture that are worked on at a time, so that they stay in the cache."""


def albedo(sensor: Sensor, rng: np.random.Generator, folder: Path | None = None) -> Image:
    """Reflectance over the contact face (see the module for the mapping), (rows, columns, 3) float32 in [0, 1]; linear.

    Where marks lie above a coating that shines, it is (rows, columns, 4): the marks' reflectance and the share of each
    texel that they cover. The camera sets the resolution, `rng` draws the pattern, and a bitmap's file is relative to
    the folder, by default the current directory. InputError for a pattern finer than the camera could see, or a bitmap
    that cannot be read.
    """
    x, y = _texels(sensor)
    coating = np.array(sensor.coating.reflectance)
    match sensor.pattern:
        case Dots() | Speckle() as pattern:
            colors, coverage = np.array(pattern.reflectance), marks_coverage(pattern, chart_of(sensor), x, y, rng)
        case Bitmap() as pattern:
            colors, coverage = painted(pattern, sensor, folder or Path(), x, y)
            colors = colors * coating
        case RandomColor() as pattern:
            return _clipped(_random_colors(pattern, x, y, rng) * coating)
        case _:
            return _clipped(np.broadcast_to(coating, (len(y), len(x), 3)))
    if pattern.layer == "above_coating" and not sensor.coating.is_matt:
        whole = np.broadcast_to(colors, (*coverage.shape, 3))
        return np.concatenate([_clipped(whole), _clipped(coverage)[:, :, None]], axis=2)
    return _blended(coating, colors, coverage)


def dots_of(sensor: Sensor, rng: np.random.Generator) -> FloatArray:
    """Places (n, 2) mm in the texture of the dots that `albedo` paints with the same `rng`; none of other patterns."""
    if not isinstance(sensor.pattern, Dots):
        return np.zeros((0, 2))
    return dot_centres(sensor.pattern, chart_of(sensor), *_texels(sensor), rng)


def _clipped(values: FloatArray) -> Image:
    texture: Image = np.empty(values.shape, dtype=np.float32)
    return np.clip(values, 0, 1, out=texture, casting="unsafe")


def _blended(coating: FloatArray, colors: FloatArray, coverage: FloatArray) -> Image:
    """The coating with marks over it: coating + coverage · (colors - coating), computed where anything is covered."""
    texture: Image = np.empty((*coverage.shape, 3), dtype=np.float32)
    texture[:] = np.clip(coating, 0, 1)
    for first in range(0, len(coverage), _STRIP):
        strip = slice(first, first + _STRIP)
        covered = np.flatnonzero(coverage[strip])
        share = coverage[strip].reshape(-1)[covered]
        mark = colors if colors.ndim == 1 else colors[strip].reshape(-1, 3)[covered]
        texture[strip].reshape(-1, 3)[covered] = np.clip(coating + share[:, None] * (mark - coating), 0, 1)
    return texture


def check_pattern(sensor: Sensor, folder: Path) -> None:
    """Find out whether `albedo` could paint a sensor's pattern, without painting it; InputError where it could not."""
    if isinstance(sensor.pattern, Bitmap):
        read_picture(sensor.pattern, folder)
        if isinstance(face := face_of(sensor.gel, folder), CadFace) and sensor.pattern.placing == "uv":
            face.textured()
    if not isinstance(sensor.pattern, NoPattern):
        _texels(sensor)


def _texels(sensor: Sensor) -> tuple[FloatArray, FloatArray]:
    """Centres of texels, x (columns,) and y (rows,), mm; InputError for a spacing, cell or grain below one texel."""
    width, height = chart_of(sensor).size_mm
    density = TEXELS_PER_PIXEL * pixels_per_mm(sensor)
    density = min(density, MAX_TEXELS / max(width, height))
    columns, rows = max(4, math.ceil(width * density)), max(4, math.ceil(height * density))
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * width
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * height
    field = {"dots": "spacing_mm", "random_color": "cell_mm", "speckle": "grain_mm"}.get(sensor.pattern.kind)
    texel_mm = max(x[1] - x[0], y[1] - y[0])
    if field and (detail := float(np.min(getattr(sensor.pattern, field)))) < texel_mm:
        raise InputError(
            f"sensor.pattern.{field} = {detail}: far finer than this camera's pixels on the gel; "
            f"it must be at least {texel_mm:.4g}"
        )
    return x, y


def pixels_per_mm(sensor: Sensor) -> float:
    """Image scale on the undeformed contact face: the finest of all cameras and directions; InputError for none.

    It is taken at the pad's middle; for a camera that does not see that, where a grid of its pixels meets the pad. For
    a pattern laid about the axis of a round gel, it is taken all over the face.
    """
    finest = max(_scale(Optics.of(view), view) for view in sensor.views.values())
    if finest == 0:
        raise InputError("no camera sees the gel pad: check sensor.camera's position_mm, look_at_mm and the mirrors")
    return round(finest, 6)


def _scale(optics: Optics, sensor: Sensor) -> float:
    """Largest stretch of the map from the contact face to pixels, in px per mm; 0 where nothing is seen."""
    chart, arms = chart_of(sensor), list(_STEP_MM * np.eye(3)[:2])
    if isinstance(chart, RoundChart):
        arc, azimuth = (a.ravel() for a in np.meshgrid(np.linspace(0.02, 0.98, 25) * chart.end, np.arange(25) / 4))
        points, path = chart.points(arc, azimuth), np.zeros(len(arc), dtype=int)
        ends = (arc + _STEP_MM, azimuth), (arc, azimuth + _STEP_MM / chart.across(arc))
        arms = [chart.points(*end) - points for end in ends]
        seen = optics.is_inside(optics.project(points))
    else:
        pixels = optics.project(np.zeros((1, 3)))
        if not optics.is_inside(pixels).all():
            edges = (np.linspace(0, side, 13) for side in (sensor.camera.width, sensor.camera.height))
            pixels = np.column_stack([axis.ravel() for axis in np.meshgrid(*edges)])
        rays = optics.look(pixels)
        points, path = rays.on_flat_face, rays.path
        with np.errstate(invalid="ignore"):
            seen = np.all(np.abs(points[:, :2]) <= np.array(sensor.gel.size_mm[:2]) / 2, axis=1)
    moved = [(optics.project(points + arm, path) - optics.project(points - arm, path)) / (2 * _STEP_MM) for arm in arms]
    jacobian = np.stack(moved, axis=2)[seen]
    jacobian = jacobian[np.isfinite(jacobian).all(axis=(1, 2))]  # NaN where a step left the lens's field
    return float(np.linalg.svd(jacobian, compute_uv=False)[:, 0].max(initial=0.0))


def is_grey(sensor: Sensor) -> bool:
    """Whether coating, pattern and lights are all grey, so that one channel tells everything."""
    pattern = sensor.pattern
    if any(camera.rest_map for camera in sensor.cameras.values()):
        return False
    if isinstance(pattern, Bitmap) or (isinstance(pattern, RandomColor) and pattern.saturation > 0):
        return False
    colors = [sensor.coating.reflectance, *(light.color for light in sensor.lights)]
    if isinstance(pattern, Dots | Speckle):
        colors.append(pattern.reflectance)
    return all(color[0] == color[1] == color[2] for color in colors)


def _random_colors(pattern: RandomColor, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(rows, columns, 3) square cells of random hue and value, each hue at least 1/8 turn from its neighbours'.

    Of neighbours the left and the upper one count. The coating's reflectance scales the colours, so that a white cell
    reflects what the bare coating would.
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
    return np.einsum("yr,rxk->yxk", vertical, np.einsum("xc,rck->rxk", horizontal, colors))


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
