"""The numbers of an inspection as tables for the terminal."""

from collections.abc import Callable
from typing import Any

from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

from synth.inspection.inspection import Inspection
from synth.inspection.text import facts, percent, short

_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("sample", lambda n: n["name"]),
    ("size\npx", lambda n: f"{n['width']}x{n['height']}"),
    ("frames", lambda n: "-".join(str(frame) for frame in n["frames"])),
    ("depth\nmm", lambda n: short(_solver(n).get("depth_mm"))),
    ("Fz\nN", lambda n: short(float(n["force_n"][1][2]))),
    ("flow\nmedian, px", lambda n: short(n["forward"]["median_px"])),
    ("flow\n95 %, px", lambda n: short(n["forward"]["p95_px"])),
    ("flow\nmax, px", lambda n: short(n["forward"]["max_px"])),
    ("no gel", lambda n: percent(n["forward"]["nan_share"])),
    ("visible", lambda n: percent(n["forward"]["visible_share"])),
    ("closure\n95 %, px", lambda n: short((n["closure"] or {}).get("p95_px"))),
    ("difference\nbefore", lambda n: percent(n["difference"]["before_rmse"])),
    ("difference\nwarped", lambda n: percent(n["difference"]["after_rmse"])),
    ("con-\nverged", lambda n: short(_solver(n).get("converged"))),
)

Column = tuple[str, list[str]]
"""Heading, and a cell for each sample."""


def _solver(numbers: dict[str, Any]) -> dict[str, Any]:
    """The record of the second frame."""
    return numbers["solver"][-1] if numbers["solver"] else {}


def tables(inspection: Inspection, width: int | None = None) -> list[Table]:
    """For `rich.console.Console.print`: of a dataset its facts and a row per sample and camera, else all numbers.

    Args:
        inspection: what was found.
        width: characters of the terminal: columns that do not fit follow in further tables. None for any number.
    """
    if inspection.kind != "dataset":
        found = []
        for place, numbers in zip(inspection.places, inspection.numbers, strict=True):
            found.append(_pairs(str(place)))
            for name, value in facts(numbers):
                found[-1].add_row(name, Text(value))
        return found
    about = _pairs(str(inspection.path))
    for name, value in about_rows(inspection):
        about.add_row(name, Text(value))
    columns = [(name, [text(numbers) for numbers in inspection.numbers]) for name, text in _COLUMNS]
    return [about, *(_samples(part) for part in _fitting(columns, width))]


def _fitting(columns: list[Column], width: int | None) -> list[list[Column]]:
    """The columns in parts that fit; each begins with the first column, which names the sample."""
    parts = [columns[:1]]
    for column in columns[1:]:
        if width is not None and len(parts[-1]) > 1 and _width([*parts[-1], column]) > width:
            parts.append(columns[:1])
        parts[-1] = [*parts[-1], column]
    return parts


def _width(columns: list[Column]) -> int:
    """Characters of a table: two of padding and a border for each column, and the last border."""
    lines = [[*name.splitlines(), *cells] for name, cells in columns]
    return 1 + sum(3 + max(cell_len(line) for line in column) for column in lines)


def _samples(columns: list[Column]) -> Table:
    rows = Table(title="samples", title_justify="left", header_style="bold")
    for name, _ in columns:
        rows.add_column(name, justify="right", overflow="fold")
    for cells in zip(*(cells for _, cells in columns), strict=True):
        rows.add_row(*map(Text, cells))
    return rows


def about_rows(inspection: Inspection) -> list[tuple[str, str]]:
    """A dataset's facts as (name, value)."""
    about = inspection.about
    seconds = ", ".join(f"{stage} {value:.3g} s" for stage, value in about["seconds"].items())
    shown = "" if about["inspected"] == about["finished"] else f" ({about['inspected']} of them looked at)"
    return [
        ("scene, seed", f"{about['scene']}, {about['seed']}"),
        ("finished samples", f"{about['finished']} of {about['n']}{shown}"),
        ("failed draws", str(about["failed_draws"])),
        ("device", ", ".join(f"{key} {value}" for key, value in about["device"].items()) or "not recorded"),
        ("software", ", ".join(f"{key} {value}" for key, value in about["software"].items()) or "not recorded"),
        ("time", seconds or "not recorded"),
    ]


def _pairs(title: str) -> Table:
    table = Table(title=Text(title, style="table.title"), title_justify="left", show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    return table
