"""A comparison on paper: tables in Markdown, numbers in CSV and JSON, plots.

Methods whose name ends in "+ft" were optimised on the very pairs that they are scored on; they have a table of their
own.
"""

import csv
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from gelflow.evaluate import MethodScore, PairScore, summarise
from gelflow.files.atomic import replacing, write_text
from gelflow.report_plots import FINE_TUNED, plot_means, plot_work_precision
from gelflow.speed import Speed
from gelflow.strata import Stratum, merged

MOST_PAIRS_IN_A_TABLE = 12
"""Above this many pairs, tables show means only; CSV and JSON always have every pair."""

FILES = ("scores.csv", "strata.csv", "scores.json", "table.md", "table.png", "work_precision.png")
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


def method_strata(scores: Sequence[PairScore]) -> dict[str, list[Stratum]]:
    """Bins over all pairs, per method."""
    methods = dict.fromkeys(score.method for score in scores)
    return {name: merged(b for score in scores if score.method == name for b in score.strata) for name in methods}


def strata_table(scores: Sequence[PairScore]) -> Table:
    """Mean endpoint error in px, a row per bin, a column per method; every pixel of a bin counts the same."""
    by_method = method_strata(scores)
    cells = {(name, s.kind, s.bin): s.error_px / s.pixels for name, strata in by_method.items() for s in strata}
    sizes = {(s.kind, s.bin): s.pixels for strata in by_method.values() for s in strata}
    rows = [
        [f"{kind}: {part}", str(pixels), *(number(cells.get((name, kind, part)), 3) for name in by_method)]
        for (kind, part), pixels in sizes.items()
    ]
    return ["where", "pixels", *by_method], rows


def speed_table(speeds: Mapping[str, Speed]) -> Table:
    """A row per network."""
    header = ["network", "device", "pairs at once", "size", "pairs/s", "peak memory MiB"]
    rows = [
        [name, s.device, str(s.batch), f"{s.size[0]}x{s.size[1]}", f"{s.pairs_per_second:.2f}", number(s.memory_mib, 0)]
        for name, s in speeds.items()
    ]
    return header, rows


def tables(scores: Sequence[PairScore], speeds: Mapping[str, Speed]) -> list[tuple[str, Table]]:
    """All tables of a comparison, each with its title."""
    means = summarise(scores)
    pairs = len({score.pair for score in scores})
    apart = [score for score in means if score.method.endswith(FINE_TUNED)]
    found = [(f"Means over {pairs} pairs; ms/pair is the median after a warm-up.",
              summary_table([score for score in means if score not in apart]))]  # fmt: skip
    if apart:
        found.append(("Fine-tuned on these very pairs (test-time optimisation, not comparable with the rest).",
                      summary_table(apart)))  # fmt: skip
    if pairs <= MOST_PAIRS_IN_A_TABLE:
        title = "Each pair: PSNR dB / SSIM, endpoint error and (distance to tracked dots) where known."
        found.append((title, pair_table(scores)))
    strata = strata_table(scores)
    if strata[1]:
        found.append(
            ("Mean endpoint error in px by the true motion, place and scene, over all pixels of a bin.", strata)
        )
    if speeds:
        found.append(("Networks alone, forward pass.", speed_table(speeds)))
    return [(title, table) for title, table in found if table[1]]


def write_report(
    out: Path, data: Sequence[str], scores: Sequence[PairScore], speeds: Mapping[str, Speed] | None = None
) -> None:
    """Writes `FILES` into a folder, each as a whole.

    Args:
        out: The folder; made if missing.
        data: The folders that were compared on.
        scores: Of all methods on all pairs; at least one.
        speeds: Of the networks, by name.

    Raises:
        OSError: A file cannot be written.
    """
    means = summarise(scores)
    pairs = len({score.pair for score in scores})
    names = [field.name for field in fields(PairScore) if field.name != "strata"]
    _write_csv(out / "scores.csv", names, [[getattr(score, name) for name in names] for score in scores])
    strata = method_strata(scores).items()
    rows = [[name, s.kind, s.bin, s.pixels, s.error_px / s.pixels, s.above_1px / s.pixels, s.above_01px / s.pixels]
            for name, bins in strata for s in bins]  # fmt: skip
    header = ["method", "kind", "bin", "pixels", "endpoint_error_px", "outliers_1px", "outliers_01px"]
    _write_csv(out / "strata.csv", header, rows)
    write_text(out / "scores.json", as_json_text(data, means, scores, speeds) + "\n")
    parts = [f"Pairs of {', '.join(data)}; times on {machine(speeds)}.\n"]
    parts += [f"{title}\n\n{markdown(table)}" for title, table in tables(scores, speeds or {})]
    write_text(out / "table.md", "\n".join(parts))
    plot_means(out / "table.png", means, pairs)
    plot_work_precision(out / "work_precision.png", means, f"{pairs} pairs; {machine(speeds)}")


def machine(speeds: Mapping[str, Speed] | None) -> str:
    """What the times were measured on."""
    devices = sorted({speed.device for speed in (speeds or {}).values()} - {"cpu"})
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    here = f"{cores} CPU cores ({platform.machine()})"
    return f"{here}, networks on {', '.join(devices)}" if devices else here


def _write_csv(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def as_json_text(
    data: Sequence[str],
    means: Sequence[MethodScore],
    scores: Sequence[PairScore],
    speeds: Mapping[str, Speed] | None = None,
) -> str:
    """The comparison as JSON; numbers that are not finite (PSNR of equal images) become null."""
    answer = {
        "data": list(data),
        "methods": [_plain(asdict(score)) for score in means],
        "scores": [_plain({k: v for k, v in asdict(score).items() if k != "strata"}) for score in scores],
        "strata": {name: [_plain(asdict(one)) for one in bins] for name, bins in method_strata(scores).items()},
        "networks": {name: asdict(speed) for name, speed in (speeds or {}).items()},
    }
    return json.dumps(answer, indent=1)


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}
