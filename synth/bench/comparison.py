"""What the rows say: the Pareto front, families compared at equal run time, targets met."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from synth.bench.fem import Row


def pareto_front(rows: Sequence[Row]) -> list[Row]:
    """Complete rows that no other beats in both time and displacement error, by rising time."""
    best, front = np.inf, []
    for row in sorted((row for row in rows if row.complete), key=lambda row: (row.seconds, row.percent)):
        if row.percent < best:
            best = row.percent
            front.append(row)
    return front


def speed_up(row: Row, rows: Sequence[Row]) -> float:
    """Run time of the plain driver's row, the first of the case, over this one's; NaN where that did not complete."""
    plain = rows[0]
    return plain.seconds / row.seconds if plain.complete else float("nan")


@dataclass(frozen=True)
class Rivalry:
    """Two families of settings at equal run time.

    Attributes:
        seconds: (n,) run times of the rival's rows that lie between the first family's run times.
        displacement: (n,) the rival's displacement error over the first family's, interpolated.
        force: (n,) the same of the force.
    """

    seconds: np.ndarray
    displacement: np.ndarray
    force: np.ndarray


def rivalry(rows: Sequence[Row], family: str, rival: str) -> Rivalry:
    """The rival's error over that of a family, whose rows are interpolated linearly in the logarithms."""
    mine, theirs = (
        sorted((row for row in rows if row.setting.family == name and row.complete), key=lambda row: row.seconds)
        for name in (family, rival)
    )
    known = np.log([row.seconds for row in mine])
    inside = [row for row in theirs if mine and mine[0].seconds <= row.seconds <= mine[-1].seconds]
    when = np.log([row.seconds for row in inside])
    ratios = []
    for quantity in ("percent", "force"):
        own = np.interp(when, known, np.log([getattr(row, quantity) for row in mine])) if inside else np.zeros(0)
        ratios.append(np.array([getattr(row, quantity) for row in inside]) / np.exp(own))
    return Rivalry(np.exp(when), ratios[0], ratios[1])


def cheapest(rows: Sequence[Row], family: str, displacement: float, force: float) -> Row | None:
    """The fastest row of a family whose worst errors (%) are within limits."""
    good = [
        row
        for row in rows
        if row.setting.family == family and row.complete and row.percent <= displacement and row.force <= force
    ]
    return min(good, key=lambda row: row.seconds, default=None)
