"""The work-precision plot of `bench flow`."""

import io
from collections.abc import Sequence
from typing import Any

from synth.bench.flow_measure import Row

STYLES = {
    "traced": ("*", "black"),
    "occlusion": ("o", "tab:blue"),
    "float32": ("D", "tab:purple"),
    "pixels": ("s", "tab:orange"),
    "vertices": ("^", "tab:green"),
    "camera": ("v", "tab:red"),
}
"""Marker and colour of each family."""
NEEDED_PX = 0.01
"""A line to draw: the flow is to be trusted to a hundredth of a pixel."""


def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """Rows of one scene that no other beats in both time and mean error, by rising time; not by visibility."""
    best, front = float("inf"), []
    for row in sorted(rows, key=lambda row: (row.ms, row.mean_px)):
        if row.mean_px < best:
            best = row.mean_px
            front.append(row)
    return front


def plot(rows: Sequence[Row]) -> bytes:
    """A PNG with a panel per scene: mean error, and a line up to the largest, against time."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row.scene for row in rows))
    figure = Figure(figsize=(5.0 * len(scenes) + 3.6, 5.2), dpi=110)
    axes = figure.subplots(1, len(scenes), squeeze=False, sharey=True)[0]
    numbers = {name: k for k, name in enumerate(dict.fromkeys(row.method for row in rows), 1)}
    for axis, scene in zip(axes, scenes, strict=True):
        _draw(axis, [row for row in rows if row.scene == scene], numbers)
        axis.set(title=scene, xlabel="processor time of a pair, both directions, ms")
    axes[0].set_ylabel("error, px (mean; line: to the largest)")
    shown: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        shown.update(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="center right", fontsize=8.5, frameon=False)
    figure.tight_layout(rect=(0, 0, 1 - 3.6 / figure.get_size_inches()[0], 1))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw(axis: Any, rows: Sequence[Row], numbers: dict[str, int]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter

    for row in rows:
        marker, colour = STYLES[row.family]
        label = f"{numbers[row.method]}  {row.method}"
        axis.plot([row.ms], [row.mean_px], marker, color=colour, markersize=8, label=label)
        axis.plot([row.ms] * 2, [row.mean_px, row.max_px], "-", color=colour, linewidth=0.8, alpha=0.5)
        axis.annotate(
            str(numbers[row.method]), (row.ms, row.mean_px), xytext=(6, -9), textcoords="offset points", fontsize=8
        )
    front = pareto_front(rows)
    x, y = [row.ms for row in front], [row.mean_px for row in front]
    axis.plot(x, y, "-", color="gold", linewidth=6, alpha=0.4, zorder=0)
    axis.plot(x, y, "o", markersize=14, fillstyle="none", color="darkgoldenrod", label="Pareto front")
    axis.axhline(NEEDED_PX, color="black", linestyle="--", linewidth=0.8)
    axis.annotate(f"{NEEDED_PX:g} px", (1, NEEDED_PX), xycoords=("axes fraction", "data"), ha="right", va="bottom",
                  fontsize=8)  # fmt: skip
    axis.set(xscale="log", yscale="log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(True, which="both", alpha=0.25)
