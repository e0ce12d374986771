"""A comparison on paper: tables in Markdown and LaTeX, numbers in CSV and JSON, plots."""

import csv
from dataclasses import fields
from pathlib import Path
from typing import Any

from gelflow.compare.comparison import Comparison
from gelflow.compare.plots import plot_means, plot_strata, plot_work_precision
from gelflow.compare.scores import PairScore
from gelflow.compare.tables import Table, tables, with_pattern
from gelflow.files.atomic import replacing, write_text

SCORES = "scores.json"
FILES = ("scores.csv", "strata.csv", SCORES, "table.md", "table.tex", "table.png", "work_precision.png", "strata.png")
"""What `write_report` writes; strata.csv and strata.png where some pair has an exact flow."""

_LATEX = {"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", ">": r"$>$", "±": r"$\pm$", "×": r"$\times$"}
_LATEX |= {"σ": r"$\sigma$", "≤": r"$\leq$"}


def markdown(table: Table) -> str:
    """A table in Markdown, numbers to the right."""
    header, rows = table
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def latex(title: str, table: Table) -> str:
    """A table in LaTeX for the package booktabs, in UTF-8."""
    header, rows = table
    lines = [" & ".join("".join(_LATEX.get(c, c) for c in cell) for cell in line) + r" \\" for line in [header, *rows]]
    caption = "".join(_LATEX.get(c, c) for c in title)
    return "\n".join([
        r"\begin{table}", rf"\caption{{{caption}}}", rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}", r"\toprule",
        lines[0], r"\midrule", *lines[1:], r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
    ])  # fmt: skip


def write_report(out: Path, comparison: Comparison) -> None:
    """Writes `FILES` into a folder, each as a whole."""
    first = ("method", "pair", "scene")
    names = [*first, *(field.name for field in fields(PairScore) if field.name not in (*first, "strata"))]
    _write_csv(out / "scores.csv", names, [[getattr(score, name) for name in names] for score in comparison.scores])
    write_text(out / SCORES, comparison.to_json() + "\n")
    found = tables(comparison)
    parts = [f"Pairs of {', '.join(comparison.data)}; times on {comparison.devices}.\n"]
    parts += [f"{title}\n\n{markdown(table)}" for title, table in found]
    write_text(out / "table.md", "\n".join(parts))
    write_text(out / "table.tex", "\n".join(latex(title, table) for title, table in found))
    groups, pairs = with_pattern(comparison)
    note = f"{pairs} pairs" if pairs == len(comparison.pairs) else f"{pairs} pairs of gels with a pattern"
    plot_means(out / "table.png", groups, note)
    plot_work_precision(out / "work_precision.png", groups, f"{note}; {comparison.devices}")
    if any(comparison.strata.values()):
        rows = [[name, s.kind, s.bin, s.pixels, s.error_px / s.pixels, s.above_1px / s.pixels, s.above_01px / s.pixels]
                for name, bins in comparison.strata.items() for s in bins]  # fmt: skip
        header = ["method", "kind", "bin", "pixels", "endpoint_error_px", "outliers_1px", "outliers_01px"]
        _write_csv(out / "strata.csv", header, rows)
        plot_strata(out / "strata.png", comparison.strata)


def _write_csv(path: Path, header: list[str], rows: list[list[Any]]) -> None:
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
