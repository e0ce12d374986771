"""A part of a job for one task of a batch queue: every N-th trajectory.

Shard i of N makes the trajectories i, i + N, i + 2 N, ... A sample depends on (scene, seed, index) alone, so that the
N shards together are bit for bit what one run makes, in whatever order and on whatever machines they run.
"""

import re
from dataclasses import dataclass

from synth.errors import InputError


@dataclass(frozen=True)
class Shard:
    """Part `number` of `count`, numbered from 0 as batch queues do."""

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """The shard that "i/N" means; InputError for another form, or i not in 0 .. N - 1."""
        found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip())
        if found is None or int(found[1]) >= int(found[2]):
            last = f"; the last of {found[2]} is {int(found[2]) - 1}/{found[2]}" if found and int(found[2]) else ""
            raise InputError(f"--shard {text}: give i/N with 0 <= i < N, such as 0/16{last}")
        return cls(int(found[1]), int(found[2]))

    @property
    def name(self) -> str:
        return f"{self.number}-of-{self.count}"

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def makes(self, trajectory: int) -> bool:
        return trajectory % self.count == self.number
