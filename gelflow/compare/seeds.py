"""Trainings that differ in nothing but their seed, as one row: mean and standard deviation.

Methods whose names (`gelflow.methods.name`) differ in their seed alone are one group. The standard deviation is the
sample's (n - 1).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean, stdev

from gelflow.compare.scores import MethodScore
from gelflow.methods.name import MethodName


@dataclass(frozen=True)
class Group:
    """Scores of one training, or of several with different seeds."""

    name: MethodName
    members: tuple[MethodScore, ...]

    @property
    def label(self) -> str:
        return str(self.name) if len(self.members) == 1 else f"{self.name} ({len(self.members)} seeds)"

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


def grouped(means: Sequence[MethodScore]) -> list[Group]:
    """Groups in the order in which their first members appear."""
    names = dict.fromkeys(score.method.group for score in means)
    return [Group(name, tuple(s for s in means if s.method.group == name)) for name in names]
