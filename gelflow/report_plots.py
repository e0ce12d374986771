"""Pictures of a comparison: the measures side by side, and quality against run time with its Pareto front."""

import math
from collections.abc import Sequence
from pathlib import Path

from gelflow.evaluate import MethodScore
from gelflow.files.atomic import replacing

NO_MOTION = "no motion"
FINE_TUNED = "+ft"
"""End of the names of methods that were trained on the very pairs."""


def plot_means(path: Path, means: Sequence[MethodScore], pairs: int) -> None:
    """Writes a PNG with a panel per measure, a row per method."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    candidates: list[tuple[str, list[float | None], str]] = [
        ("PSNR (dB), more is better", [score.psnr_db for score in means], "linear"),
        ("SSIM, more is better", [score.ssim for score in means], "linear"),
        ("endpoint error (px), less is better", [score.endpoint_error_px for score in means], "log"),
        ("time (ms/pair)", [1000 * score.seconds for score in means], "log"),
    ]
    panels = [panel for panel in candidates if any(value is not None for value in panel[1])]
    figure = Figure(figsize=(3.2 * len(panels) + 1, 0.45 * len(means) + 1.3), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    places = list(range(len(means)))
    for axis, (label, values, scale) in zip(axes, panels, strict=True):
        drawn = [(value, place) for value, place in zip(values, places, strict=True)
                 if value is not None and math.isfinite(value) and (scale == "linear" or value > 0)]  # fmt: skip
        axis.set_xscale(scale)
        axis.plot([value for value, _ in drawn], [place for _, place in drawn], "o", color="#4477aa")
        for value, place in drawn:
            axis.annotate(
                f"{value:.4g}" if value < 1000 else f"{value:.0f}",
                (value, place),
                (0, 6),
                textcoords="offset points",
                ha="center",
                fontsize=8,
            )
        axis.margins(x=0.2)
        axis.set_title(label, fontsize=9)
        axis.tick_params(labelsize=8)
        axis.xaxis.set_minor_formatter("")
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_yticks(places, [score.method for score in means])
    axes[0].set_ylim(len(means) - 0.4, -0.8)
    figure.suptitle(f"means over {pairs} pairs", fontsize=10)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points that no other beats in both coordinates (less is better), by the first coordinate."""
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda i: points[i]):
        if not front or points[index][1] < points[front[-1]][1]:
            front.append(index)
    return front


def plot_work_precision(path: Path, means: Sequence[MethodScore], note: str) -> None:
    """Writes a PNG with quality against run time: endpoint error where it is known, and PSNR.

    Methods that no other beats in both are joined; those that were fine-tuned on the very pairs are hollow and not
    part of the front.

    Args:
        path: The PNG.
        means: Of the methods; "no motion" takes no time worth drawing and is left out.
        note: What the times were measured on.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [score for score in means if score.method != NO_MOTION]
    candidates: list[tuple[str, list[float | None], float]] = [
        ("mean endpoint error (px)", [score.endpoint_error_px for score in shown], 1.0),
        ("PSNR (dB)", [score.psnr_db for score in shown], -1.0),
    ]
    panels = [panel for panel in candidates if any(value is not None and math.isfinite(value) for value in panel[1])]
    figure = Figure(figsize=(5.2 * max(1, len(panels)), 4.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, max(1, len(panels)), squeeze=False)[0]
    for axis, (label, values, sign) in zip(axes, panels, strict=False):
        known = [(score, value) for score, value in zip(shown, values, strict=True)
                 if value is not None and math.isfinite(value)]  # fmt: skip
        plain = [(score, value) for score, value in known if not score.method.endswith(FINE_TUNED)]
        front = pareto_front([(score.seconds, sign * value) for score, value in plain])
        joined = [(1000 * plain[i][0].seconds, plain[i][1]) for i in front]
        axis.plot(
            [x for x, _ in joined], [y for _, y in joined], "-", color="#cc6677", linewidth=1, label="Pareto front"
        )
        for score, value in known:
            hollow = score.method.endswith(FINE_TUNED)
            axis.plot(
                1000 * score.seconds, value, "o", color="#4477aa", markerfacecolor="white" if hollow else "#4477aa"
            )
            axis.annotate(score.method, (1000 * score.seconds, value), (4, 4), textcoords="offset points", fontsize=7.5)
        axis.set_xscale("log")
        if sign > 0 and all(value > 0 for _, value in known):
            axis.set_yscale("log")
        axis.set_xlabel("ms per pair")
        axis.set_ylabel(label)
        axis.margins(x=0.25, y=0.12)
        axis.grid(color="0.9", which="both")
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        if joined:
            axis.legend(fontsize=8, frameon=False)
    figure.suptitle(note, fontsize=9)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png")
