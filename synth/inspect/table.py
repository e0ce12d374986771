"""The numbers of an inspection as tables for the terminal."""

from rich.cells import cell_len
from rich.table import Table
from rich.text import Text

from synth.inspect.inspection import Inspection
from synth.inspect.text import COLUMNS, about_rows, facts

Column = tuple[str, list[str]]
"""Heading, and a cell for each sample."""


def tables(inspection: Inspection, width: int | None = None) -> list[Table]:
    """For `rich.console.Console.print`: of a dataset its facts and a row per sample and camera, else all numbers.

    Columns that do not fit the terminal's width in characters, where one is given, follow in further tables.
    """
    if inspection.kind != "dataset":
        return [_pairs(str(place), facts(n)) for place, n in zip(inspection.places, inspection.numbers, strict=True)]
    columns = [(name, [text(numbers) for numbers in inspection.numbers]) for name, text in COLUMNS]
    return [
        _pairs(str(inspection.path), about_rows(inspection)),
        *(_samples(part) for part in _fitting(columns, width)),
    ]


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


def _pairs(title: str, rows: list[tuple[str, str]]) -> Table:
    table = Table(title=Text(title, style="table.title"), title_justify="left", show_header=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, Text(value))
    return table
