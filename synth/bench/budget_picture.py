"""Measured against predicted error, a panel for each scene."""

import io
import math
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from synth.bench.budget_verdict import Verdict

COLOURS = {
    "sphere": "tab:blue",
    "cylinder": "tab:orange",
    "box": "tab:green",
    "cone": "tab:red",
    "torus": "tab:purple",
    "mesh": "tab:brown",
}
"""Of the indenter's shapes."""
COLUMNS = 4
LEGEND_INCHES = 2.1


def can_draw() -> bool:
    """Whether matplotlib is there."""
    return find_spec("matplotlib") is not None


def measured_against_predicted(verdicts: Sequence[Verdict]) -> bytes:
    """A PNG: every rung that was run, the chosen ones large, with the target as lines.

    Draws that are not judged are left out.
    """
    from matplotlib.figure import Figure

    judged = [verdict for verdict in verdicts if verdict.judged]
    names = list(dict.fromkeys(verdict.scene for verdict in verdicts))
    columns = min(COLUMNS, len(names))
    lines = math.ceil(len(names) / columns)
    figure = Figure(figsize=(4.0 * columns + LEGEND_INCHES, 4.2 * lines), dpi=90)
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    axes = list(grid.flat)[: len(names)]
    for place, (axis, name) in enumerate(zip(axes, names, strict=True)):
        _panel(axis, [verdict for verdict in judged if verdict.scene == name])
        axis.set_title(name, fontsize=11)
        if place + columns >= len(names):
            axis.set_xlabel("predicted error, px")
            axis.tick_params(labelbottom=True)
    for axis in list(grid.flat)[len(names) :]:
        axis.remove()
    for axis in grid[:, 0]:
        axis.set_ylabel("measured error, px")
    shown: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        shown.update(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="center right", fontsize=9, frameon=False)
    figure.tight_layout(rect=(0, 0, 1 - LEGEND_INCHES / figure.get_size_inches()[0], 1))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _panel(axis: Any, verdicts: Sequence[Verdict]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    for body, colour in COLOURS.items():
        own = [verdict for verdict in verdicts if verdict.body == body]
        small = [(r.predicted_px, r.error_px) for v in own for r in v.rungs if r.name != v.chosen]
        large = [(v.predicted_px, v.error_px) for v in own]
        if small:
            axis.plot(*zip(*small, strict=True), "o", color=colour, markersize=3, alpha=0.4, zorder=2)
        if large:
            axis.plot(
                *zip(*large, strict=True),
                "o",
                color=colour,
                markersize=8,
                markeredgecolor="black",
                label=body,
                zorder=3,
            )
    axis.set_xscale("log")
    axis.set_yscale("log")
    for scale in (axis.xaxis, axis.yaxis):
        scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        scale.set_major_formatter("{x:g}")
        scale.set_minor_formatter(NullFormatter())
    for target in sorted({verdict.target_px for verdict in verdicts}):
        axis.axhline(target, color="black", linestyle="--", linewidth=1.0, label="target", zorder=1)
        axis.axvline(target, color="black", linestyle="--", linewidth=1.0, zorder=1)
    axis.axline((1, 1), (2, 2), color="grey", linewidth=0.8, label="measured = predicted", zorder=1)
    axis.grid(True, which="both", alpha=0.25)
