"""One picture of the suite: each run's contact surface in its last recorded state, seen from the indenter's side."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from synth.stress.check import Verdict

COLUMNS = 8
NOTHING_MM = 1e-9
"""Displacement that is rounding: no pattern is drawn in it."""
QUARTERS = ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
"""A quadratic face (vertices, then midpoints of its edges 01, 12, 20) as four flat triangles."""
COLOURS = {"as expected": "black", "explained": "darkorange", "OTHERWISE": "red"}


def write_sheet(verdicts: Sequence[Verdict], path: Path) -> None:
    """A panel per run, coloured by the length of the displacement; refusals as text."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(verdicts))
    rows = math.ceil(len(verdicts) / columns)
    figure = Figure(figsize=(2.4 * columns, 2.2 * rows), dpi=80)
    for place, verdict in enumerate(verdicts):
        pressed = len(verdict.result.states) > 0
        row, column = divmod(place, columns)
        left, bottom = column / columns, 1 - (row + 1) / rows
        middle = left + 0.5 / columns
        title = f"{verdict.result.run.name}\n{verdict.result.outcome}"
        figure.text(middle, bottom + 0.99 / rows, title, fontsize=8, color=COLOURS[verdict.word], ha="center", va="top")
        if pressed:
            place_of = (left, bottom + 0.04 / rows, 1 / columns, 0.84 / rows)
            largest = _draw_surface(figure.add_axes(place_of, projection="3d"), verdict)
            figure.text(middle, bottom + 0.02 / rows, f"{largest:.3g} mm", fontsize=7, ha="center")
        else:
            text = "\n".join(textwrap.wrap(verdict.result.message or "; ".join(verdict.broken), 34)[:8])
            figure.text(middle, bottom + 0.45 / rows, text, fontsize=7, ha="center", va="center")
    figure.savefig(path)


def _draw_surface(axes: Any, verdict: Verdict) -> float:
    """The deformed contact face, looking into the dent; returns the largest displacement, mm."""
    from matplotlib import colormaps
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    arrays = verdict.result.arrays
    nodes, faces = arrays["surface_nodes"], arrays["surface_faces"]
    if faces.shape[1] == 6:
        faces = np.concatenate([faces[:, part] for part in QUARTERS])
    moved = arrays["displacement"][-1][nodes]
    corners = (arrays["points"][nodes] + moved)[faces]
    length = np.linalg.norm(moved, axis=1)
    largest = float(length.max())
    shade = colormaps["viridis"](length[faces].mean(axis=1) / max(largest, NOTHING_MM))
    axes.add_collection3d(Poly3DCollection(corners, facecolors=shade, edgecolors="k", linewidths=0.15))
    flat = corners.reshape(-1, 3)
    low, high = flat.min(axis=0), flat.max(axis=0)
    reach = float((high - low).max()) / 2
    for limit, middle in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), (low + high) / 2, strict=True):
        limit(middle - reach, middle + reach)
    axes.invert_zaxis()
    axes.set_box_aspect((1, 1, 1), zoom=1.5)
    axes.view_init(elev=35, azim=-60)
    axes.set_axis_off()
    return largest
