"""Which share of every texel the marks of a pattern cover: dots and speckle.

Edges are at least one texel wide, so that the texture holds no detail beyond its own resolution.
"""

import math

import numpy as np

from synth.arrays import FloatArray
from synth.scene import Dots, Speckle


def dots_coverage(pattern: Dots, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Dots on a jittered grid; the share falls from 1 to 0 over `softness_mm` around their edges.

    Args:
        pattern: the grid.
        x: (columns,) texel centres, mm; even.
        y: (rows,) likewise.
        rng: draws three normal numbers for every dot.

    Returns:
        (rows, columns) in [0, 1].
    """
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
            right, down = x[None, columns] - cx, y[rows, None] - cy
            if pattern.shape == "round":
                inside = radius - np.hypot(right, down)
            else:
                inside = (radius - np.abs(right * c + down * s) - np.abs(down * c - right * s)) / math.sqrt(2)
            dot = np.clip(inside / softness + 0.5, 0, 1)
            coverage[rows, columns] = np.maximum(coverage[rows, columns], dot)
    return coverage


def speckle_coverage(pattern: Speckle, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Gaussian-filtered white noise, cut at the level that leaves `coverage` of the area above it.

    By Rice's formula a line crosses the level u (in standard deviations) exp(-u²/2) / (pi sqrt(2) sigma) times per
    length, sigma being the filter's. With sigma = grain_mm / 4 and u = 0 its mean chord through a grain is
    pi sqrt(2) sigma = 1.11 grain_mm. Arguments and result as of `dots_coverage`.
    """
    from scipy.ndimage import gaussian_filter

    pitch = (y[1] - y[0], x[1] - x[0])
    sigma = [max(0.5, pattern.grain_mm / 4 / step) for step in pitch]
    noise = gaussian_filter(rng.standard_normal((len(y), len(x))), sigma, mode="wrap")
    noise /= noise.std()
    level = np.quantile(noise, 1 - pattern.coverage)
    # The noise's rms slope is 1 / (sqrt(2) sigma) per texel: this makes the edge about one texel wide.
    return np.clip((noise - level) * math.sqrt(2) * min(sigma) + 0.5, 0, 1)
