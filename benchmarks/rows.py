"""A benchmark's measurements: rows in a CSV file that a repeated run goes on with, a printed table, and a plot.

A *case* is a dictionary of everything that a result depends on; its columns are the keys of the table. Measuring it
gives a row: the case and what was found. Values are text, numbers, truth values or None, as they stand in the CSV.

    rows = measure(out / "fem.csv", cases, press, workers=2)
    show(rows, ["mesh", "seconds", "error_percent"], "Error of the displacement")
    plot(out / "fem.png", rows, x="seconds", y="error_percent", group="family")
"""

import argparse
import csv
import math
import os
import platform
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

Row = dict[str, Any]


def arguments(name: str, question: str | None) -> argparse.ArgumentParser:
    """The parser of a script's command line, with `--out`; its help is the script's docstring."""
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(f"python -m benchmarks {name}", description=question, formatter_class=style)
    parser.add_argument("--out", type=Path, default=Path("data/benchmarks"), help="directory for table and plot")
    return parser


def measure(path: Path, cases: Iterable[Row], one: Callable[[Row], Row | list[Row]], workers: int = 1) -> list[Row]:
    """Measure the cases that a CSV file has no row of, and add what was found as soon as it is there.

    The file is replaced as a whole after every case, so that a run that is killed leaves only whole rows.

    Args:
        path: the CSV file; its directory is made. Rows of cases that are not asked for stay in it.
        cases: what to measure, all with the same columns.
        one: measures a case: takes it, returns the columns found, or a list of such if the case has several rows.
            With workers it runs in another process.
        workers: how many cases are measured at once; 1 measures in this process, which timings ask for.

    Returns:
        The rows of the cases, in their order.
    """
    wanted = list(cases)
    rows = read(path)
    keys = list(wanted[0]) if wanted else []
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(_key(row, keys), []).append(row)
    missing = list({_key(case, keys): case for case in wanted if _key(case, keys) not in found}.values())
    if len(missing) < len(wanted):
        print(f"{path}: {len(missing)} of {len(wanted)} cases are still to be measured", file=sys.stderr)

    def add(case: Row, columns: Row | list[Row]) -> None:
        new = [{**case, **each} for each in (columns if isinstance(columns, list) else [columns])]
        found[_key(case, keys)] = new
        rows.extend(new)
        write(path, rows)
        for row in new:
            told = (f"{name}={_written(value)}" for name, value in row.items() if value is not None)
            print(" ".join(told), file=sys.stderr, flush=True)

    if workers > 1:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:  # Warp and Mitsuba do not survive a fork
            running = {pool.submit(one, case): case for case in missing}
            for done in as_completed(running):
                add(running[done], done.result())
    else:
        for case in missing:
            add(case, one(case))
    return [{**row, **case} for case in wanted for row in found[_key(case, keys)]]


def read(path: Path) -> list[Row]:
    """The rows of a CSV file; none if there is no such file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [{name: _parsed(text) for name, text in row.items() if text != ""} for row in csv.DictReader(file)]


def write(path: Path, rows: Sequence[Row]) -> None:
    """Write rows as a CSV file, whose columns are all that any row has; a value that is missing or None is empty."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    with beside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)
    beside.replace(path)


def show(rows: Iterable[Row], columns: Sequence[str], title: str = "") -> None:
    """Print a table of some columns."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns, title=title or None, box=box.MARKDOWN, title_justify="left")
    for row in rows:
        table.add_row(*(_written(row.get(name)) for name in columns))
    Console(width=None if sys.stdout.isatty() else 200).print(table)


LABELS = {
    "ms": "processor time, ms",
    "seconds": "processor time, s",
    "processor_s": "processor time, s",
    "mean_px": "mean error, px",
    "error_px": "error, px",
    "sigma_px": "sigma, px",
    "predicted_px": "predicted error, px",
    "displacement_percent": "displacement error, %",
    "rmse": "error, levels of 255",
}
"""Of a plot's axes, by column; other columns stand there by their name."""


def plot(path: Path, rows: Sequence[Row], x: str, y: str, group: str, panel: str = "", style: str = "o-") -> None:
    """Draw y against x, both logarithmic, a line for each value of `group` and a picture for each value of `panel`.

    `style` is Matplotlib's, "o" for points without lines. Rows without a positive number in both columns are left out.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    seen = [row for row in rows if all(isinstance(row.get(name), float | int) and row[name] > 0 for name in (x, y))]
    panels = list(dict.fromkeys(row.get(panel) for row in seen)) or [None]
    groups = list(dict.fromkeys(str(row.get(group)) for row in seen))
    figure = Figure(figsize=(4.5 * len(panels) + 2, 4.5), layout="constrained")
    lines = {}
    for axes, value in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for name in groups:
            line = [row for row in seen if row.get(panel) == value and str(row.get(group)) == name]
            line.sort(key=lambda row: row[x])
            (lines[name],) = axes.loglog([row[x] for row in line], [row[y] for row in line], style, label=name)
        axes.set(xlabel=LABELS.get(x, x), ylabel=LABELS.get(y, y), title=None if value is None else str(value))
        axes.grid(which="both", alpha=0.3)
        if seen:  # Matplotlib places no marks on a logarithmic axis without values
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_formatter(NullFormatter())
    figure.legend(handles=lines.values(), fontsize="small", loc="outside right center")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def machine() -> str:
    """Say in a line what timings were measured on: processor, cores, load and versions."""
    told = Path("/proc/cpuinfo")
    lines = told.read_text(encoding="utf-8", errors="replace").splitlines() if told.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    parts = [models[0] if models else platform.processor() or platform.machine(), f"{os.cpu_count()} cores"]
    if hasattr(os, "getloadavg"):
        parts.append(f"load {os.getloadavg()[2]:.1f} over the last 15 minutes")
    for name in ("gelflow-synth", "numpy", "warp-lang", "mitsuba"):
        with suppress(PackageNotFoundError):  # a checkout on a machine that simulates only
            parts.append(f"{name} {version(name)}")
    return ", ".join(parts)


def _key(row: Row, keys: Sequence[str]) -> tuple[str, ...]:
    """A case's identity, the same before it is written and after it is read."""
    return tuple("" if row.get(name) is None else str(_parsed(str(row[name]))) for name in keys)


def _parsed(text: str) -> Any:
    """A CSV's field as the value that was written."""
    if text in ("True", "False"):
        return text == "True"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def _written(value: Any) -> str:
    """A value as a table shows it."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
