"""What the command line shows: progress on stderr, a bar on a terminal, else a line now and then; tables on stdout."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.cells import cell_len
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from gelflow.errors import printable

Advance = Callable[[int, int, str], None]
"""Takes the number of items done, the number of all, and a word on the present one."""
LINE_S = 60.0
"""Seconds between two lines."""


class _Rate(ProgressColumn):
    """Items per second, or seconds per item where that is slow."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("")
        return Text(f"{speed:.1f}/s" if speed >= 1 else f"{1 / speed:.1f} s each", style="cyan")


@contextmanager
def progress(label: str, shown: bool = True) -> Iterator[Advance]:
    """Shows progress while the block runs; yields the function that moves it."""
    console = Console(stderr=True)
    if shown and not console.is_terminal:
        yield _lines(label)
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), _Rate(),
               TimeRemainingColumn(), TextColumn("{task.fields[item]}", markup=False))  # fmt: skip
    with Progress(*columns, console=console, disable=not shown, transient=True) as bar:
        task = bar.add_task(label, total=None, item="")
        yield lambda done, total, item: bar.update(task, completed=done, total=total, item=printable(item))


def _lines(label: str) -> Advance:
    told = time.monotonic()

    def advance(done: int, total: int, item: str) -> None:
        nonlocal told
        if time.monotonic() - told >= LINE_S and done < total:
            told = time.monotonic()
            print(printable(f"gelflow: {label}: {done} of {total}{item and f'; {item}'}"), file=sys.stderr, flush=True)

    return advance


def show_table(title: str, header: list[str], rows: list[list[str]]) -> None:
    """Prints a table on stdout; columns but the first to the right, nothing cut off.

    Columns that are too many for the width of a terminal follow in further tables, which repeat the first one.
    """
    console = Console()
    if not console.is_terminal:
        console.width = 10_000  # wider than any table
    console.print(Text(title, "bold"))
    first, *others = zip(header, *rows, strict=True)
    parts = [[first]]
    for column in others:
        width = 1 + sum(3 + max(map(cell_len, cells)) for cells in (*parts[-1], column))  # with borders and padding
        if len(parts[-1]) > 1 and width > console.width:
            parts.append([first])
        parts[-1].append(column)
    for part in parts:
        table = Table()
        for number, (name, *_) in enumerate(part):
            table.add_column(Text(name), justify="right" if number else "left", no_wrap=number > 0, overflow="fold")
        for row in list(zip(*part, strict=True))[1:]:
            table.add_row(*map(Text, map(printable, row)))
        console.print(table)
