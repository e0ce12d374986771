"""Pictures of a comparison: quality against run time with its Pareto front, and errors by place."""

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

from gelflow.compare.seeds import Group
from gelflow.compare.strata import BARE, EDGE, MOTION, PATTERN, Stratum, pooled
from gelflow.files.atomic import replacing
from gelflow.methods.name import MethodName

UNTIMED = ("no motion", "exact flow")
"""Methods that take no time worth drawing."""
RED = "#cc6677"
COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377", "#bbbbbb", "#000000", "#ee7733")
MARKERS = "osD^vPX"


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other beats in both coordinates (less is better), by the first coordinate."""
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if not front or points[index][1] < points[front[-1]][1]:
            front.append(index)
    return front


def plot_work_precision(path: Path, groups: Sequence[Group], note: str) -> None:
    """Writes a PNG with quality against run time: endpoint error or distance from dots, and PSNR.

    Methods that no other beats in both are joined; those that were fine-tuned on the very pairs are hollow and not
    part of the front. A black edge means that it ran on a GPU. The note says what the times were measured on.
    """
    shown = [group for group in groups if group.name.label not in UNTIMED]
    candidates = [
        ("mean endpoint error (px)", "endpoint_error_px", 1.0),
        ("median distance from dots (px)", "dot_distance_px", 1.0),
        ("PSNR (dB)", "psnr_db", -1.0),
    ]
    panels = [panel for panel in candidates if any(_finite(group.mean(panel[1])) for group in shown)]
    looks = _looks([group.name for group in groups])
    figure, axes = _figure(max(1, len(panels)), 4.6 * max(1, len(panels)) + 2.2, 4.2)
    for axis, (label, field, sign) in zip(axes, panels, strict=False):
        known = [(g, 1000 * (g.mean("cost_seconds") or 0.0), g.mean(field) or 0.0) for g in shown
                 if _finite(g.mean(field))]  # fmt: skip
        plain = [(x, y) for group, x, y in known if not group.name.fine_tuned]
        joined = [plain[i] for i in pareto_front([(x, sign * y) for x, y in plain])]
        if joined:
            axis.plot(*zip(*joined, strict=True), "-", color=RED, linewidth=1, label="Pareto front")
        for group, x, y in known:
            colour, marker = looks[group.name]
            face = "white" if group.name.fine_tuned else colour
            edge = "black" if any(one.on_gpu for one in group.members) else colour
            axis.plot(x, y, marker=marker, markersize=7, color=colour, markerfacecolor=face, markeredgecolor=edge,
                      linestyle="none", label=group.label)  # fmt: skip
        axis.set_xscale("log")
        if sign > 0 and all(y > 0 for _, _, y in known):
            axis.set_yscale("log")
        axis.set_xlabel("ms per pair (CPU: of one core)")
        axis.set_ylabel(label)
        axis.margins(x=0.1, y=0.1)
    _legend(axes[-1])
    _save(figure, path, note)


def plot_strata(path: Path, strata: Mapping[MethodName, Sequence[Stratum]]) -> None:
    """Writes a PNG with the mean endpoint error by true motion, by distance to the contact's edge and by patterns."""
    by_method = pooled(strata)
    present = {(one.kind, one.bin) for bins in by_method.values() for one in bins}
    kinds = [kind for kind in (MOTION, EDGE, PATTERN) if sum(kind in each for each in present) > (kind == PATTERN)]
    kinds = kinds or [kind + BARE for kind in (MOTION, EDGE)]
    looks = _looks(list(by_method))
    figure, axes = _figure(len(kinds), 5.0 * len(kinds) + 1.5, 4.4)
    for axis, kind in zip(axes, kinds, strict=True):
        names = [one.bin for one in next(iter(by_method.values())) if one.kind == kind]
        for method, bins in by_method.items():
            colour, marker = looks[method]
            values = {one.bin: one.error_px / one.pixels for one in bins if one.kind == kind}
            drawn = [(k, values[name]) for k, name in enumerate(names) if values.get(name, 0) > 0]
            if drawn:
                line = "none" if kind == PATTERN else "-"
                look = {"marker": marker, "markersize": 4, "linewidth": 1, "linestyle": line}
                axis.plot(*zip(*drawn, strict=True), color=colour, label=str(method), **look)
        axis.set_yscale("log")
        axis.set_xticks(range(len(names)), [name.removesuffix(" px") for name in names], rotation=30, ha="right")
        axis.set_xlabel(kind if kind == PATTERN else f"{kind} (px)", fontsize=9)
    axes[0].set_ylabel("mean endpoint error (px)")
    _legend(axes[-1])
    _save(figure, path, "")


def _finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _looks(names: Sequence[MethodName]) -> dict[MethodName, tuple[str, str]]:
    """Colour and marker of each method, the same in every panel; 56 differ."""
    return dict(zip(names, zip(cycle(COLOURS), cycle(MARKERS), strict=False), strict=False))


def _legend(axis: Any) -> None:
    if any(axis.get_legend_handles_labels()[0]):
        axis.legend(fontsize=7.5, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _figure(panels: int, width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    return figure, figure.subplots(1, panels, squeeze=False)[0]


def _save(figure: Any, path: Path, title: str) -> None:
    for axis in figure.axes:
        axis.tick_params(labelsize=8, which="both")
        axis.grid(color="0.9", which="major")
        if axis.get_yscale() == "log":
            axis.yaxis.set_major_formatter("{x:g}")
            low, high = axis.get_ylim()
            shown = "25" if high > 20 * low else "234568"
            axis.yaxis.set_minor_formatter(lambda y, _, shown=shown: f"{y:g}" if f"{y:e}"[0] in shown else "")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title, fontsize=9)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
