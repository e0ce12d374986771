"""Trainings that differ in nothing but their seed, as one row: mean and standard deviation.

Methods whose labels differ in a number after "#" alone ("best#0", "best#1"; "best#0+ft", "best#1+ft") are one group.
The standard deviation is the sample's (n - 1).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gelflow.compare.scores import MethodScore

FINE_TUNED = "+ft"
"""End of the names of methods that were optimised on the very pairs that they are scored on."""

_SEED = re.compile(r"#\d+(?=$|\+ft$)")


def group_name(method: str) -> str:
    """A method's name without the number of its seed."""
    return _SEED.sub("", method)


@dataclass(frozen=True)
class Group:
    """Scores of one training, or of several with different seeds."""

    name: str
    members: "tuple[MethodScore, ...]"

    @property
    def label(self) -> str:
        return self.name if len(self.members) == 1 else f"{self.name} ({len(self.members)} seeds)"

    @property
    def fine_tuned(self) -> bool:
        return self.name.endswith(FINE_TUNED)

    @property
    def device(self) -> str:
        """What it ran on; several devices are joined by a slash."""
        return " / ".join(dict.fromkeys(one.device for one in self.members))

    def mean(self, field: str) -> float | None:
        """Mean of a measure of `MethodScore`; None unless every member has it."""
        values = [getattr(one, field) for one in self.members]
        return None if any(value is None for value in values) else fmean(values)

    def spread(self, field: str) -> float | None:
        """Standard deviation of a measure over the seeds; None with fewer than two, or where one lacks it."""
        values = [getattr(one, field) for one in self.members]
        return None if len(values) < 2 or any(value is None for value in values) else stdev(values)


def grouped(means: "Sequence[MethodScore]") -> list[Group]:
    """Groups in the order in which their first members appear."""
    names = dict.fromkeys(group_name(score.method) for score in means)
    return [Group(name, tuple(s for s in means if group_name(s.method) == name)) for name in names]
