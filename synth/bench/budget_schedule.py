"""Which press to begin next, when all have to end by a deadline.

Presses are begun in a given order, but none that is not expected to end in time; a shorter one is begun in its place.
Expected times are OVERHEAD_S and the press's work times the largest time per work of those that have ended; until one
has, every press is expected to end in time.
"""

import math
import time
from collections.abc import Callable, Mapping

from synth.bench.budget_study import Job

OVERHEAD_S = 20.0
"""Of a press, whatever its work: a process that starts, mesh, pattern, probing; generous, so that short presses, whose
time it is, do not make the long ones look longer than they are."""


class Schedule:
    """The presses that are still to begin."""

    def __init__(
        self, work: Mapping[Job, float], deadline: float = math.inf, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Of jobs in the order in which to begin them.

        Args:
            work: of each job, in any unit.
            deadline: of the clock, by which all are to end.
            clock: in seconds.
        """
        self._work, self._left = dict(work), list(work)
        self._deadline, self._clock = deadline, clock
        self._pace = 0.0
        self._began: dict[Job, float] = {}

    def begin(self) -> Job | None:
        """The next job, which then counts as begun; None where none is expected to end in time."""
        now = self._clock()
        for job in self._left:
            overhead = OVERHEAD_S if self._pace else 0.0
            if now < self._deadline and now + overhead + self._pace * self._work[job] <= self._deadline:
                self._left.remove(job)
                self._began[job] = now
                return job
        return None

    def end(self, job: Job) -> None:
        """Take note that a job that was begun has ended."""
        took = self._clock() - self._began.pop(job)
        self._pace = max(self._pace, (took - OVERHEAD_S) / self._work[job])
