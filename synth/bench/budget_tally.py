"""Verdicts counted: of a scene, and of all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from synth.bench.budget_verdict import Verdict

GOAL = 0.95
"""Share of the draws that are to be within their budget, and of those whose mesh is to cost at most twice the cheapest
within it."""


@dataclass(frozen=True)
class Tally:
    """Counts of verdicts.

    Attributes:
        name: of the scene, or "all".
        draws: asked for.
        unfinished: with presses to do.
        judged: with an error.
        replaced: by `generate`, since the press on the chosen mesh stops; not judged.
        within: the budget, of those judged.
        added, extrapolated: within it by the two estimates of `synth.bench.budget_verdict`.
        payable: of those judged, with a rung within the budget.
        affordable, affordable_nominal: of those payable, by processor time and by unknowns.
        untimed: of those payable, compared by unknowns both times, as their presses ran on different machines.
        median, high: of error over target, and its 95th percentile; NaN where none is judged.
        bias, scatter: geometric mean of measured over predicted error of the chosen meshes, and standard deviation of
            its logarithm; NaN where none is judged.
    """

    name: str
    draws: int
    unfinished: int
    judged: int
    replaced: int
    within: int
    added: int
    extrapolated: int
    payable: int
    affordable: int
    affordable_nominal: int
    untimed: int
    median: float
    high: float
    bias: float
    scatter: float

    @property
    def finished(self) -> bool:
        """Whether all of its presses are done."""
        return not self.unfinished

    @property
    def met(self) -> bool:
        """Whether both shares reach GOAL; not where nothing is judged."""
        accurate = self.judged > 0 and self.within >= GOAL * self.judged
        return accurate and self.affordable >= GOAL * self.payable


def tally(name: str, verdicts: Sequence[Verdict], undrawn: int = 0) -> Tally:
    """Count.

    Args:
        name: of what is counted.
        verdicts: of its draws.
        undrawn: draws asked for that no attempt gave.
    """
    judged = [verdict for verdict in verdicts if verdict.judged]
    payable = [verdict for verdict in judged if verdict.cheapest() is not None]
    share = np.array([verdict.error_px / verdict.target_px for verdict in judged])
    ratios = [verdict.error_px / verdict.predicted_px for verdict in judged if verdict.predicted_px * verdict.error_px]
    logarithms = np.log(ratios)
    return Tally(
        name=name,
        draws=len(verdicts) + undrawn,
        unfinished=sum(verdict.unfinished for verdict in verdicts),
        judged=len(judged),
        replaced=sum(verdict.replaced for verdict in verdicts),
        within=sum(verdict.within for verdict in judged),
        added=sum(verdict.added_px <= verdict.target_px for verdict in judged),
        extrapolated=sum(verdict.extrapolated_px <= verdict.target_px for verdict in judged),
        payable=len(payable),
        affordable=sum(verdict.affordable() for verdict in payable),
        affordable_nominal=sum(verdict.affordable(nominal=True) for verdict in payable),
        untimed=sum(not verdict.timed_together for verdict in payable),
        median=float(np.median(share)) if judged else math.nan,
        high=float(np.quantile(share, 0.95)) if judged else math.nan,
        bias=float(np.exp(logarithms.mean())) if ratios else math.nan,
        scatter=float(logarithms.std()) if ratios else math.nan,
    )
