"""A comparison on paper: table in Markdown, numbers in CSV and JSON, a plot."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from gelflow.evaluate import MethodScore, PairScore, summarise
from gelflow.files.atomic import replacing, write_text

MOST_PAIRS_IN_A_TABLE = 12
"""Above this many pairs, tables show means only; CSV and JSON always have every pair."""

FILES = ("scores.csv", "scores.json", "table.md", "table.png")
"""What `write_report` writes."""

Table = tuple[list[str], list[list[str]]]
"""Header and rows, as text."""


def number(value: float | None, digits: int) -> str:
    """A number for a table; a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """A share as per cent for a table; a dash where there is none."""
    return "-" if value is None else f"{100 * value:.1f}"


def summary_table(scores: Sequence[MethodScore]) -> Table:
    """Means over the pairs, a row per method; columns that no method has are left out.

    The distance to dots is not averaged here: tracks differ too much in how far they can be trusted.
    """
    header = ["method", "PSNR dB", "SSIM", "EPE px", "median px", "> 1 px %", "> 0.1 px %", "ms/pair"]
    rows = [
        [
            score.method,
            number(score.psnr_db, 2),
            number(score.ssim, 4),
            number(score.endpoint_error_px, 3),
            number(score.median_error_px, 3),
            percent(score.outliers_1px),
            percent(score.outliers_01px),
            number(1000 * score.seconds, 1),
        ]
        for score in scores
    ]
    kept = [column for column in range(len(header)) if any(row[column] != "-" for row in rows)]
    return [header[column] for column in kept], [[row[column] for column in kept] for row in rows]


def pair_table(scores: Sequence[PairScore]) -> Table:
    """A row per pair, a column per method: PSNR / SSIM, then the endpoint error and the distance to dots if known."""
    methods = list(dict.fromkeys(score.method for score in scores))
    cells = {(score.pair, score.method): _cell(score) for score in scores}
    pairs = list(dict.fromkeys(score.pair for score in scores))
    return ["pair", *methods], [[pair, *(cells.get((pair, method), "-") for method in methods)] for pair in pairs]


def _cell(score: PairScore) -> str:
    text = f"{score.psnr_db:.2f} / {score.ssim:.3f}"
    if score.endpoint_error_px is not None:
        text += f" / {score.endpoint_error_px:.3f} px"
    if score.marker_distance_px is not None:
        text += f" ({score.marker_distance_px:.2f} px)"
    return text


def markdown(table: Table) -> str:
    """A table in Markdown, numbers to the right."""
    header, rows = table
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def write_report(out: Path, data: Sequence[str], scores: Sequence[PairScore]) -> None:
    """Writes scores.csv, scores.json, table.md and table.png into a folder, each as a whole.

    Args:
        out: The folder; made if missing.
        data: The folders that were compared on.
        scores: Of all methods on all pairs; at least one.

    Raises:
        OSError: A file cannot be written.
    """
    means = summarise(scores)
    pairs = len({score.pair for score in scores})
    with replacing(out / "scores.csv") as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        names = [field.name for field in fields(PairScore)]
        writer.writerow(names)
        writer.writerows([getattr(score, name) for name in names] for score in scores)
    write_text(out / "scores.json", as_json_text(data, means, scores) + "\n")
    text = f"Means over {pairs} pairs of {', '.join(data)}; ms/pair is the median.\n\n{markdown(summary_table(means))}"
    if pairs <= MOST_PAIRS_IN_A_TABLE:
        text += "\nEach pair: PSNR dB / SSIM, endpoint error and (distance to tracked dots) where known.\n\n"
        text += markdown(pair_table(scores))
    write_text(out / "table.md", text)
    _plot(out / "table.png", means, pairs)


def as_json_text(data: Sequence[str], means: Sequence[MethodScore], scores: Sequence[PairScore]) -> str:
    """The comparison as JSON; numbers that are not finite (PSNR of equal images) become null."""
    answer = {
        "data": list(data),
        "methods": [_plain(asdict(score)) for score in means],
        "scores": [_plain(asdict(score)) for score in scores],
    }
    return json.dumps(answer, indent=1)


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}


def _plot(path: Path, means: Sequence[MethodScore], pairs: int) -> None:
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
