"""The work-precision plot."""

import io
from typing import Any

from synth.bench.comparison import pareto_front
from synth.bench.fem import Results, Row

STYLES = {
    "graded P2/P1": ("o", "tab:blue"),
    "graded, few layers P2/P1": ("X", "navy"),
    "graded, wide P2/P1": ("P", "deepskyblue"),
    "graded P1/P1": ("s", "tab:orange"),
    "graded P1": ("x", "tab:red"),
    "fTetWild P2/P1": ("^", "tab:green"),
    "fTetWild P1/P1": ("v", "tab:olive"),
    "uniform P2/P1": ("D", "tab:purple"),
    "uniform P1/P1": ("p", "tab:brown"),
    "uniform P1": ("+", "darkred"),
    "load step": ("<", "tab:cyan"),
    "penalty": (">", "tab:pink"),
    "contact points": ("h", "deeppink"),
    "factor": ("d", "tab:gray"),
    "plain driver": ("*", "black"),
}
"""Marker and colour of each family."""
TARGETS = (1.0, 2.0)
"""Lines to draw, %."""


def work_precision(results: Results) -> bytes:
    """A PNG: a column per case; above errors in % of the displacement, below in px of the image."""
    from matplotlib.figure import Figure

    cases = [case for case, _ in results.suite.cases]
    figure = Figure(figsize=(5.2 * len(cases) + 2.2, 8.4), dpi=110)
    axes = figure.subplots(2, len(cases), squeeze=False, sharex="col", sharey="row")
    for column, case in enumerate(cases):
        rows = results.of(case)
        for axis, quantity in zip(axes[:, column], ("percent", "px"), strict=True):
            _draw(axis, rows, quantity)
        for target in TARGETS:
            axes[0, column].axhline(target, color="black", linestyle="--", linewidth=0.8)
            axes[0, column].annotate(f"{target:g} %", (1, target), xycoords=("axes fraction", "data"), ha="right",
                                     va="bottom", fontsize=8)  # fmt: skip
        axes[0, column].set_title(f"{case.name} (judged: {', '.join(case.poses[k] for k in case.judged)})", fontsize=10)
        axes[1, column].set_xlabel("processor time of the press, s")
    axes[0, 0].set_ylabel("error of the surface's displacement, %")
    axes[1, 0].set_ylabel(f"error along the face, px ({results.px_per_mm:.1f} px/mm)")
    shown: dict[str, Any] = {}
    for axis in axes.ravel():
        handles, labels = axis.get_legend_handles_labels()
        shown.update(zip(labels, handles, strict=True))
    figure.legend(shown.values(), shown.keys(), loc="center right", fontsize=9, frameon=False)
    figure.tight_layout(rect=(0, 0, 1 - 2.2 / figure.get_size_inches()[0], 1))
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw(axis: Any, rows: list[Row], quantity: str) -> None:
    """One panel; lines join settings that differ in their mesh only."""
    for family, (marker, colour) in STYLES.items():
        members = sorted((r for r in rows if r.setting.family == family and r.complete), key=lambda row: row.seconds)
        if members:
            joined = "-" if "P" in family else ""
            x, y = [row.seconds for row in members], [getattr(row, quantity) for row in members]
            axis.plot(x, y, joined, marker=marker, color=colour, label=family, markersize=7, linewidth=0.8)
    front = pareto_front(rows)
    if quantity == "percent" and front:
        x, y = [row.seconds for row in front], [row.percent for row in front]
        axis.plot(x, y, "-", color="gold", linewidth=6, alpha=0.4, zorder=0)
        axis.plot(x, y, "o", markersize=14, fillstyle="none", color="darkgoldenrod", label="Pareto front")
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.grid(True, which="both", alpha=0.25)
