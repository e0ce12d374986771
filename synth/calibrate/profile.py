r"""What a dot's edge tells: its radius, its brightness and the blur of the lens.

A disk of radius R seen through a Gaussian point spread σ covers at the distance r from its centre

.. math::  Q(r) = P(|x| < R), \quad x \sim N(r e, σ^2 I)

which is the distribution function of a noncentral χ² with 2 degrees of freedom, at R²/σ² with noncentrality r²/σ². The
pixel's square (variance 1/12 px²) and the dot's own soft edge (w²/12) are taken off σ².
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import ncx2

from synth.arrays import FloatArray
from synth.calibrate.dots import SMALLEST_PX, FoundDots, check_size

_BIN_PX = 0.25


@dataclass(frozen=True, eq=False)
class DotProfile:
    """What all dots have in common: their disks' radius, and its relative standard deviation.

    `spread_px` is the standard deviation of point spread, pixel and soft edge together; `ratio` (3,) a dot's
    reflectance over the coating's.
    """

    radius_px: float
    radius_jitter: float
    spread_px: float
    ratio: FloatArray


def fit_profile(dots: FoundDots) -> DotProfile:
    """Fit the model to the median profile of all dots, each dot scaled to the common radius first.

    InputError where the dots are too small to have an edge.
    """
    common = float(np.median(dots.radii))
    check_size(common)
    distance, values = _samples(dots, common)
    edges = np.arange(0, 2 * common, _BIN_PX)
    bins = np.digitize(distance, edges) - 1
    filled = [k for k in range(len(edges) - 1) if np.count_nonzero(bins == k) >= 5]
    r = edges[filled] + _BIN_PX / 2
    seen = np.array([np.median(values[bins == k], axis=0) for k in filled])
    grey = seen.mean(axis=1)

    def model(p: FloatArray) -> FloatArray:
        radius, spread, inside, outside = p
        return np.asarray(outside + (inside - outside) * ncx2.cdf((radius / spread) ** 2, 2, (r / spread) ** 2))

    start = [common, SMALLEST_PX, max(float(grey[0]), 0.0), 1.0]
    found = least_squares(
        lambda p: model(p) - grey, start, bounds=([0.3 * common, 0.2, 0, 0.5], [2 * common, common, np.inf, 1.5])
    )
    radius, spread = found.x[:2]
    share = ncx2.cdf((radius / spread) ** 2, 2, (r / spread) ** 2)
    # With radius and spread known, each channel's profile is linear in its brightness inside and outside.
    inside, outside = np.linalg.lstsq(np.column_stack([share, 1 - share]), seen, rcond=None)[0]
    scatter = 1.4826 * float(np.median(np.abs(dots.radii / common - 1)))
    return DotProfile(float(radius), scatter, float(spread), np.maximum(inside / outside, 0))


def blur_of(profile: DotProfile, softness_px: float) -> float:
    """Standard deviation of the lens's point spread, px."""
    return float(np.sqrt(max(profile.spread_px**2 - (1 + softness_px**2) / 12, 0.0)))


def _samples(dots: FoundDots, common: float) -> tuple[FloatArray, FloatArray]:
    """Distances (k,) px from the dots' centres and ratios (k, 3) there."""
    reach = int(np.ceil(2 * common))
    height, width = dots.covered.shape
    distances, values = [], []
    for centre, radius in zip(dots.centres, dots.radii, strict=True):
        column, row = (int(c) for c in centre)
        rows = np.arange(max(0, row - reach), min(height, row + reach + 1))
        columns = np.arange(max(0, column - reach), min(width, column + reach + 1))
        away = np.hypot(columns[None, :] + 0.5 - centre[0], rows[:, None] + 0.5 - centre[1])
        distances.append((away + common - radius).ravel())  # the edges of all dots at the same place
        values.append(dots.ratio[np.ix_(rows, columns)].reshape(-1, 3))
    return np.concatenate(distances), np.concatenate(values)
