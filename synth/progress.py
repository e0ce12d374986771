"""How far a long command is, on stderr: a bar on a terminal, elsewhere a line now and then; with rate and estimate."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich import progress as bars
from rich.console import Console
from rich.text import Text

Advance = Callable[[int, int], None]
"""Called with items done and items in all."""

LINE_S = 60.0
"""Seconds between two lines."""


@contextmanager
def progress(label: str, total: int | None = None) -> Iterator[Advance]:
    """Shows progress while the block runs; the label names what is done, `total` is known from the start or None."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(label)
        return
    text, done, times = bars.TextColumn("{task.description}"), bars.MofNCompleteColumn(), bars.TimeElapsedColumn()
    columns = (text, bars.BarColumn(), done, _Rate(), times, bars.TimeRemainingColumn())
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(label, total=total)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def duration(seconds: float) -> str:
    """A time as a person says it, "3.2 min"."""
    if seconds < 90:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _lines(label: str) -> Advance:
    """Prints a line every LINE_S at most, with the rate since the first call; what was there before cost no time."""
    told = time.monotonic()
    first: tuple[float, int] | None = None

    def advance(done: int, total: int) -> None:
        nonlocal told, first
        now = time.monotonic()
        first = first or (now, done)
        if now - told < LINE_S or done >= total:
            return
        told = now
        rate = (done - first[1]) / (now - first[0]) if done > first[1] and now > first[0] else 0.0
        estimate = f", {_speed(rate)}, about {duration((total - done) / rate)} left" if rate > 0 else ""
        print(f"synth: {label}: {done} of {total}{estimate}", file=sys.stderr, flush=True)

    return advance


def _speed(rate: float) -> str:
    """Items per second, or seconds per item where that is slow."""
    return f"{rate:.1f}/s" if rate >= 1 else f"{1 / rate:.1f} s each"


class _Rate(bars.ProgressColumn):
    def render(self, task: bars.Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(_speed(speed) if speed else "", style="cyan")
