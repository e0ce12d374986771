"""Comparing methods on the same pairs, and the report: tables in Markdown and LaTeX, numbers in CSV and JSON, plots."""

import json
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

from gelflow.compare.comparison import Comparison
from gelflow.compare.plots import plot_strata, plot_work_precision
from gelflow.compare.scores import PairScore, evaluate
from gelflow.compare.speed import Speed, network_speed
from gelflow.compare.tables import Table, tables, with_pattern
from gelflow.data.pairs import PairDataset
from gelflow.errors import InputError
from gelflow.files.atomic import write_csv, write_text
from gelflow.methods.learned import Learned, PublishedRaft
from gelflow.methods.method import Method
from gelflow.models.working_size import working_sizes


def compare(
    methods: Sequence[Method],
    dataset: PairDataset,
    out: Path | None = None,
    progress: Callable[[PairScore], None] | None = None,
    batch: int = 1,
) -> Comparison:
    """Scores every method on every pair, method after method; their names differ.

    `out` is a folder for the report, written anew after each method, so that an interruption loses one method at most;
    an earlier comparison on the same data is replaced. `progress` is called after each pair. The speed of networks is
    measured with `batch` pairs at once; 0: it is not. InputError for no method, two of one name, an `out` that holds
    other things, or a pair that cannot be read; OSError where a file cannot be written.
    """
    names = [str(method.name) for method in methods]
    if not names:
        raise InputError("no method given; there is nothing to compare")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two methods are called {name!r}; give one a label of its own: --weights LABEL=FILE")
    result = Comparison((dataset.source,), (), {}, {})
    if out is not None:
        _check_out(out, dataset)
    for method in methods:
        scores = evaluate(method, dataset, progress)
        result = result.with_method(scores, _speed(method, dataset, batch))
        if out is not None:
            write_report(out, result)
    return result


def _speed(method: Method, dataset: PairDataset, batch: int) -> Speed | None:
    if batch == 0 or not isinstance(method, Learned | PublishedRaft):
        return None
    rows, columns = dataset.images(0)[0].shape[:2]
    size = method.size or getattr(method.model, "image_size", None)
    size = size or (working_sizes(rows, columns)[0] if isinstance(method, Learned) else (rows, columns))
    return network_speed(method.forward, size, batch, method.device)


def _check_out(out: Path, dataset: PairDataset) -> None:
    """Refuses a folder that holds anything but a comparison on the same data."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    try:
        data = ", ".join(json.loads((out / SCORES).read_text(encoding="utf-8"))["data"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{out}: exists and holds other things; give an empty or a new folder as --out") from error
    if data != dataset.source:
        raise InputError(f"{out}: holds a comparison on {data}, not on {dataset.source}; give another --out")


SCORES = "scores.json"
FILES = ("scores.csv", "strata.csv", SCORES, "table.md", "table.tex", "work_precision.png", "strata.png")
"""What `write_report` writes; strata.csv and strata.png where some pair has an exact flow."""

_LATEX = {"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", ">": r"$>$", "±": r"$\pm$", "×": r"$\times$"}
_LATEX |= {"σ": r"$\sigma$", "≤": r"$\leq$", "{": r"\{", "}": r"\}", "$": r"\$", "\\": r"\textbackslash{}"}
_LATEX |= {"^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}


def markdown(table: Table) -> str:
    """A table in Markdown, numbers to the right."""
    header, rows = table
    lines = [header, ["---"] + ["---:"] * (len(header) - 1), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines) + "\n"


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
    write_csv(out / "scores.csv", names, [[getattr(score, name) for name in names] for score in comparison.scores])
    write_text(out / SCORES, comparison.to_json() + "\n")
    found = tables(comparison)
    parts = [f"Pairs of {', '.join(comparison.data)}; times on {comparison.devices}.\n"]
    parts += [f"{title}\n\n{markdown(table)}" for title, table in found]
    write_text(out / "table.md", "\n".join(parts))
    write_text(out / "table.tex", "\n".join(latex(title, table) for title, table in found))
    groups, pairs = with_pattern(comparison)
    note = f"{pairs} pairs" if pairs == len(comparison.pairs) else f"{pairs} pairs of gels with a pattern"
    plot_work_precision(out / "work_precision.png", groups, f"{note}; {comparison.devices}")
    if any(comparison.strata.values()):
        rows = [[name, s.kind, s.bin, s.pixels, s.error_px / s.pixels, s.above_1px / s.pixels, s.above_01px / s.pixels]
                for name, bins in comparison.strata.items() for s in bins]  # fmt: skip
        header = ["method", "kind", "bin", "pixels", "endpoint_error_px", "outliers_1px", "outliers_01px"]
        write_csv(out / "strata.csv", header, rows)
        plot_strata(out / "strata.png", comparison.strata)
