"""Which share of every texel the marks of a pattern, dots and speckle, cover on flat faces and on round ones.

Edges are at least one texel wide, so that the texture holds no detail beyond its own resolution. Texels of round faces
lie as `synth.render.chart.RoundChart` says; there marks have their true sizes on the face.
"""

import math
from collections.abc import Iterator

import numpy as np

from synth.arrays import FloatArray
from synth.render.chart import Chart, RoundChart
from synth.scene import Dots, Speckle

_STEPS_PER_GRAIN = 16
"""Steps a grain of the noise from which the grains of round faces are cut."""


def marks_coverage(
    pattern: Dots | Speckle, chart: Chart, x: FloatArray, y: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """The share of each texel that is covered, (rows, columns) in [0, 1].

    The chart says how the texture is laid on the face; x (columns,) and y (rows,) are texel centres, mm, both even.
    `rng` draws three normal numbers for every dot, or the noise that grains are cut from.
    """
    if isinstance(pattern, Dots):
        return _round_dots(pattern, chart, x, y, rng) if isinstance(chart, RoundChart) else _dots(pattern, x, y, rng)
    if isinstance(chart, RoundChart):
        return _round_speckle(pattern, chart, x, y, rng)
    return _speckle(pattern, x, y, rng)


def _dots(pattern: Dots, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Dots on a jittered grid; the share falls from 1 to 0 over `softness_mm` around their edges."""
    softness = max(pattern.softness_mm, x[1] - x[0], y[1] - y[0])
    coverage = np.zeros((len(y), len(x)))
    c, s = math.cos(math.radians(pattern.rotation_deg)), math.sin(math.radians(pattern.rotation_deg))
    for cx, cy, radius in _grid(pattern, x, y, rng):
        reach = radius + softness
        rows = slice(*np.searchsorted(y, [cy - reach, cy + reach]))
        columns = slice(*np.searchsorted(x, [cx - reach, cx + reach]))
        right, down = x[None, columns] - cx, y[rows, None] - cy
        if pattern.shape == "round":
            inside = radius - np.hypot(right, down)
        else:
            inside = (radius - np.abs(right * c + down * s) - np.abs(down * c - right * s)) / math.sqrt(2)
        dot = np.clip(inside / softness + 0.5, 0, 1)
        coverage[rows, columns] = np.maximum(coverage[rows, columns], dot)
    return coverage


def _grid(
    pattern: Dots, x: FloatArray, y: FloatArray, rng: np.random.Generator
) -> Iterator[tuple[float, float, float]]:
    """Centres x, y and radii, mm, of the dots of a jittered grid."""
    (sx, sy), (ox, oy) = pattern.spacing_mm, pattern.offset_mm
    c, s = math.cos(math.radians(pattern.rotation_deg)), math.sin(math.radians(pattern.rotation_deg))
    corners = [(u - ox, v - oy) for u in (x[0], x[-1]) for v in (y[0], y[-1])]
    along, across = [(u * c + v * s) / sx for u, v in corners], [(v * c - u * s) / sy for u, v in corners]
    for j in range(math.floor(min(across)), math.ceil(max(across)) + 1):
        for i in range(math.floor(min(along)), math.ceil(max(along)) + 1):
            dx, dy, grow = rng.standard_normal(3)
            cx = ox + i * sx * c - j * sy * s + pattern.jitter_mm * dx
            cy = oy + i * sx * s + j * sy * c + pattern.jitter_mm * dy
            yield cx, cy, pattern.radius_mm * max(0.0, 1 + pattern.radius_jitter * grow)


def dot_centres(pattern: Dots, chart: Chart, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Places (n, 2) mm in the texture of the centres of all dots that have a size; arguments as of `marks_coverage`."""
    if isinstance(chart, RoundChart):
        dots = [(s * math.cos(a), s * math.sin(a), radius) for s, a, radius in _meridians(pattern, chart, rng)]
    else:
        dots = list(_grid(pattern, x, y, rng))
    return np.array([dot[:2] for dot in dots if dot[2] > 0]).reshape(-1, 2)


def _speckle(pattern: Speckle, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Gaussian-filtered white noise, cut at the level that leaves `coverage` of the area above it.

    By Rice's formula a line crosses the level u (in standard deviations) exp(-u²/2) / (pi sqrt(2) sigma) times per
    length, sigma being the filter's. With sigma = grain_mm / 4 and u = 0 its mean chord through a grain is
    pi sqrt(2) sigma = 1.11 grain_mm.
    """
    from scipy.ndimage import gaussian_filter

    pitch = (y[1] - y[0], x[1] - x[0])
    sigma = [max(0.5, pattern.grain_mm / 4 / step) for step in pitch]
    noise = gaussian_filter(rng.standard_normal((len(y), len(x))), sigma, mode="wrap")
    noise /= noise.std()
    level = np.quantile(noise, 1 - pattern.coverage)
    # The noise's rms slope is 1 / (sqrt(2) sigma) per texel: this makes the edge about one texel wide.
    return np.clip((noise - level) * math.sqrt(2) * min(sigma) + 0.5, 0, 1)


def _round_dots(pattern: Dots, chart: RoundChart, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Dots along meridians; where they would be less than their size apart, half as many, evenly spread."""
    softness = max(pattern.softness_mm, x[1] - x[0], y[1] - y[0])
    coverage = np.zeros((len(y), len(x)))
    for place, angle, radius in _meridians(pattern, chart, rng):
        far = place + radius + softness
        reach = (radius + softness) * max(1.0, far / float(chart.across(far)))
        cx, cy = place * math.cos(angle), place * math.sin(angle)
        rows = slice(*np.searchsorted(y, [cy - reach, cy + reach]))
        columns = slice(*np.searchsorted(x, [cx - reach, cx + reach]))
        u, v = np.meshgrid(x[columns], y[rows])
        arm = chart.points(np.hypot(u, v), np.arctan2(v, u)) - chart.points(np.array(place), np.array(angle))
        away = np.linalg.norm(arm, axis=-1)
        if pattern.shape == "diamond":
            aside_mm = np.abs(arm @ (-math.sin(angle), math.cos(angle), 0.0))
            away = (aside_mm + np.sqrt(np.maximum(away**2 - aside_mm**2, 0))) / math.sqrt(2)
            radius /= math.sqrt(2)
        dot = np.clip((radius - away) / softness + 0.5, 0, 1)
        coverage[rows, columns] = np.maximum(coverage[rows, columns], dot)
    return coverage


def _meridians(pattern: Dots, chart: RoundChart, rng: np.random.Generator) -> Iterator[tuple[float, float, float]]:
    """Arcs mm from the tip, azimuths and radii mm of the dots of a round face."""
    (across_mm, along_mm), (turned, first) = pattern.spacing_mm, pattern.offset_mm
    meridians = max(1, round(2 * math.pi * chart.radius / across_mm))
    if pattern.placing == "spherical":
        arcs = np.arange(first % along_mm, chart.end, along_mm)
    else:
        arcs = chart.arc(np.arange(first % along_mm, chart.top, along_mm))
    for arc in arcs:
        room = max(1.0, 2 * math.pi * float(chart.across(np.array(arc))) / (4 * pattern.radius_mm))
        count = max(1, meridians // 2 ** max(0, math.ceil(math.log2(meridians / room))))
        for azimuth in turned / chart.radius + 2 * math.pi / count * np.arange(count):
            shift, aside, grow = rng.standard_normal(3)
            place = max(0.0, arc + pattern.jitter_mm * shift)
            angle = azimuth + pattern.jitter_mm * aside / max(float(chart.across(place)), pattern.radius_mm)
            yield place, angle, pattern.radius_mm * max(0.0, 1 + pattern.radius_jitter * grow)


def _round_speckle(
    pattern: Speckle, chart: RoundChart, x: FloatArray, y: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Grains cut from noise over arc and azimuth that each row filters by its own width."""
    from scipy.ndimage import gaussian_filter1d, map_coordinates

    step, sigma = pattern.grain_mm / _STEPS_PER_GRAIN, pattern.grain_mm / 4
    arc: FloatArray = step * np.arange(math.ceil(chart.end / step) + 2.0)
    columns = math.ceil(2 * math.pi * chart.radius / step)
    across = np.maximum(chart.across(arc), 1e-9)[:, None]
    wave = np.arange(columns // 2 + 1)
    response = np.exp(-0.5 * (wave * sigma / across) ** 2)
    power = (response**2 * np.where((wave == 0) | (2 * wave == columns), 1, 2)).sum(axis=1, keepdims=True) / columns
    spectrum = np.fft.rfft(rng.standard_normal((len(arc), columns)), axis=1) * response / np.sqrt(power)
    noise = gaussian_filter1d(np.fft.irfft(spectrum, columns, axis=1), sigma / step, axis=0, mode="reflect")
    noise /= np.sqrt(np.average(noise**2, weights=np.broadcast_to(across, noise.shape)))
    u, v = np.meshgrid(x, y)
    row, column = np.hypot(u, v) / step, np.arctan2(v, u) % (2 * np.pi) / (2 * np.pi) * columns
    noise = np.column_stack([noise, noise[:, :1]])
    values = map_coordinates(noise, [np.minimum(row, len(arc) - 1), column], order=1)
    inside = np.hypot(u, v) < chart.end
    share = chart.across(np.hypot(u, v)) / np.maximum(np.hypot(u, v), 1e-9)  # of a texel's area that is the face's
    order = np.argsort(values[inside])
    area = np.cumsum(share[inside][order])
    level = values[inside][order][np.searchsorted(area, (1 - pattern.coverage) * area[-1])]
    # The noise's rms slope is 1 / (sqrt(2) sigma): this makes the edge about one texel wide.
    return np.clip((values - level) * math.sqrt(2) * sigma / max(x[1] - x[0], y[1] - y[0]) + 0.5, 0, 1)
