"""A thinned flow, magnified so that small flows can be seen."""

from dataclasses import dataclass

import numpy as np

from synth.arrays import Pixels
from synth.inspection.view import View
from synth.inspection.wheel import robust_scale


@dataclass(frozen=True)
class Arrows:
    """Arrows to draw over an image.

    Attributes:
        start: (n, 2) px.
        tip: (n, 2) px, start + magnification * flow.
        magnification: how many times longer than the flow the arrows are.
    """

    start: Pixels
    tip: Pixels
    magnification: float


def arrows_of(view: View, across: int = 18) -> Arrows:
    """About `across` arrows in a row; all but the longest 1 % are at most 1.6 times as long as their spacing."""
    height, width = view.size
    spacing = max(1, round(width / across))
    columns, rows = np.meshgrid(np.arange(spacing // 2, width, spacing), np.arange(spacing // 2, height, spacing))
    flow = view.flow.forward[rows.ravel(), columns.ravel()].astype(np.float64)
    known = np.isfinite(flow).all(axis=-1)
    start = np.column_stack([columns.ravel(), rows.ravel()])[known].astype(np.float64) + 0.5
    magnification = _round_down(1.6 * spacing / robust_scale(view.flow.forward))
    return Arrows(start, start + magnification * flow[known], magnification)


def _round_down(value: float) -> float:
    """To 1, 2, 3, 5 or 7 times a power of ten."""
    unit = 10.0 ** np.floor(np.log10(value))
    step = next(step for step in (7, 5, 3, 2, 1) if step <= value / unit * (1 + 1e-9))
    return float(step * unit)
