"""What a comparison's tables do not count: `python docs/counts.py SCORES.csv METHOD [--scene WORDS] [--without WORDS]`

SCORES.csv is that of `gelflow compare --out`. A row for each method in it, seeds apart: its means, on how many pairs
it errs by at most 0.1 px and by more than 1 px, its worst pair, and on how many METHOD is above it in PSNR and SSIM,
nearer to the exact flow in the mean and in the median pixel. `--scene dots` keeps the pairs whose scene names it, as
"gelsight, dots" does; `--without none` leaves such pairs out.
"""

import argparse
import csv
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

from gelflow.report import markdown

Row = dict[str, str]
COLUMNS = ("psnr_db", "ssim", "endpoint_error_px", "median_error_px")


def mean(rows: list[Row], column: str, digits: int) -> str:
    """Over the rows that have a value."""
    values = [float(row[column]) for row in rows if row[column]]
    return f"{fmean(values):.{digits}f}" if values else "–"


def count(rows: list[Row], wanted: Callable[[float], bool]) -> str:
    """Rows whose mean error is as wanted, where there is an exact flow."""
    errors = [float(row["endpoint_error_px"]) for row in rows if row["endpoint_error_px"]]
    return str(sum(map(wanted, errors))) if errors else "–"


def worst(rows: list[Row]) -> str:
    """The largest mean error."""
    errors = [float(row["endpoint_error_px"]) for row in rows if row["endpoint_error_px"]]
    return f"{max(errors):.4f}" if errors else "–"


def beaten(best: list[Row], rows: list[Row], column: str) -> str:
    """Pairs of both on which `best` is better, of how many."""
    other = {(row["scene"], row["pair"]): row[column] for row in rows}
    both = [(row[column], other.get((row["scene"], row["pair"]), "")) for row in best]
    values = [(float(one), float(two)) for one, two in both if one and two]
    larger = column in COLUMNS[:2]
    return f"{sum((a > b) if larger else (a < b) for a, b in values)} of {len(values)}" if values else "–"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scores", type=Path)
    parser.add_argument("method")
    parser.add_argument("--scene", default="")
    parser.add_argument("--without", default="no scene's name")
    given = parser.parse_args()
    methods: dict[str, list[Row]] = defaultdict(list)
    with given.scores.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if given.scene in row["scene"] and given.without not in row["scene"]:
                methods[row["method"]].append(row)
    if given.method not in methods:
        parser.error(f"{given.scores} has no {given.method!r}; it has {', '.join(map(repr, methods))}")
    better = [f"{given.method} better in {what}" for what in ("PSNR", "SSIM", "mean px", "median px")]
    head = [
        "method",
        "pairs",
        "PSNR dB",
        "SSIM",
        "mean px",
        "median px",
        "at most 0.1 px",
        "above 1 px",
        "worst px",
        *better,
    ]
    table = [
        [
            method, str(len(rows)), mean(rows, "psnr_db", 2), mean(rows, "ssim", 4),
            mean(rows, "endpoint_error_px", 4), mean(rows, "median_error_px", 4),
            count(rows, lambda px: px <= 0.1), count(rows, lambda px: px > 1.0),
            worst(rows),
            *(beaten(methods[given.method], rows, column) for column in COLUMNS),
        ]
        for method, rows in methods.items()
    ]  # fmt: skip
    print(markdown((head, table)))


if __name__ == "__main__":
    main()
