r"""Whether a draw's mesh met its budget, and whether a cheaper one would have.

The error that is judged is measured against a reference that errs, too. Two estimates of how much that may change:

- the reference's own error, added to the error: d_r / ((h_f / h_r)^{1.6} - 1), where d_r is the difference of the
  finest rung that was run, of spacing h_f, from the reference;
- where errors fall as h^1.6 and rung and reference err alike, the error itself, from a difference d of the two, is

.. math::  d / (1 - (h_r / h)^{1.6})

with h and h_r their spacings under the contact. Where their errors are independent it is less than d.
"""

import math
from dataclasses import dataclass
from functools import cached_property

from synth.bench.budget_press import Measurement
from synth.bench.report import RATE
from synth.planning.prediction import SOLVE_GROWTH

LARGEST_RATIO = 2.0
"""Of the chosen mesh's cost over that of the cheapest rung within the budget."""


@dataclass(frozen=True)
class Rung:
    """One mesh that a draw was run on.

    Attributes:
        measurement: of its press.
        error_px: against the reference; NaN where there is none.
        predicted_px: by the error model.
    """

    measurement: Measurement
    error_px: float
    predicted_px: float

    @property
    def name(self) -> str:
        """Which."""
        return self.measurement.rung

    @property
    def seconds(self) -> float:
        """Processor time of its press."""
        return self.measurement.seconds

    @property
    def nominal(self) -> float:
        """Cost that depends on nothing but the mesh, as `synth.plan` has it for an iteration."""
        return float(self.measurement.unknowns**SOLVE_GROWTH)

    def within(self, target_px: float) -> bool:
        """Whether its error is; not where there is none."""
        return self.error_px <= target_px


@dataclass(frozen=True)
class Verdict:
    """One draw.

    Attributes:
        scene, index: which.
        body: shape of the indenter.
        depth_mm: of the press.
        target_px: its budget.
        chosen: name of the rung that its budget asks for.
        predicted_px: of that mesh.
        rungs: those that were run, rising; without those that are still to do.
        reference: its press; None while that is to do.
        seen: smallest share of the picture's points at which one of the errors is taken.
        missing: presses that are still to do.
    """

    scene: str
    index: int
    body: str
    depth_mm: float
    target_px: float
    chosen: str
    predicted_px: float
    rungs: tuple[Rung, ...]
    reference: Measurement | None
    seen: float = 1.0
    missing: int = 0

    @cached_property
    def trouble(self) -> str:
        """Why nothing can be said of the draw; empty where it can."""
        if self.unfinished or self.reference is None:
            return f"unfinished: {self.missing} presses to do"
        if self.replaced:
            press = self.chosen_rung.measurement
            return f"the chosen mesh's press is {press.status}, so that `generate` replaces the draw: {press.reason}"
        if not self.reference.complete:
            return f"the reference is {self.reference.status}: {self.reference.reason}"
        if math.isnan(self.error_px):
            return f"only {100 * self.seen:.0f} % of the picture's points stay in the picture, too few to judge by"
        return ""

    @property
    def unfinished(self) -> bool:
        """Whether presses are still to do."""
        return self.missing > 0

    @property
    def replaced(self) -> bool:
        """Whether the press on the chosen mesh stops on its way, so that `generate` draws again."""
        return not self.unfinished and not self.chosen_rung.measurement.complete

    def _rung(self, name: str) -> Rung:
        return next(rung for rung in self.rungs if rung.name == name)

    @property
    def judged(self) -> bool:
        """Whether something can be said of it."""
        return not self.trouble

    @property
    def chosen_rung(self) -> Rung:
        """The press on the mesh that `generate` takes."""
        return self._rung(self.chosen)

    @property
    def error_px(self) -> float:
        """Of the chosen mesh."""
        return self.chosen_rung.error_px

    @property
    def within(self) -> bool:
        """Whether the chosen mesh met the budget."""
        return self.chosen_rung.within(self.target_px)

    @property
    def doubt_px(self) -> float:
        """The reference's own error, by Richardson's extrapolation from the finest rung that was run."""
        if self.reference is None:
            return math.nan
        finest = self.rungs[-1]
        ratio = finest.measurement.spacing_mm / self.reference.spacing_mm
        return finest.error_px / (ratio**RATE - 1) if ratio > 1 else math.nan

    @property
    def added_px(self) -> float:
        """The error with all of the doubt added to it."""
        return self.error_px + self.doubt_px

    @property
    def extrapolated_px(self) -> float:
        """The error if rung and reference err alike."""
        if self.reference is None or self.error_px == 0:
            return self.error_px
        ratio = self.reference.spacing_mm / self.chosen_rung.measurement.spacing_mm
        return self.error_px / (1 - ratio**RATE) if ratio < 1 else math.nan

    @property
    def timed_together(self) -> bool:
        """Whether the chosen mesh and the coarser ones within the budget were pressed on one machine, so that their
        times compare. (Finer ones cost more, but for luck; those of other machines are then left out.)
        """
        chosen, good = self.chosen_rung, self._good
        coarser = [rung for rung in good if rung.nominal < chosen.nominal]
        return all(self._beside(rung) for rung in coarser) and (not good or any(map(self._beside, good)))

    @property
    def _good(self) -> list[Rung]:
        return [rung for rung in self.rungs if rung.within(self.target_px)]

    def _beside(self, rung: Rung) -> bool:
        return rung.measurement.machine == self.chosen_rung.measurement.machine

    def cheapest(self, nominal: bool = False) -> Rung | None:
        """Of the rungs that met the budget, the one of the least cost; None where none did.

        By time; `nominal`, or where times do not compare, by unknowns.
        """
        if nominal or not self.timed_together:
            return min(self._good, key=lambda rung: rung.nominal, default=None)
        return min(filter(self._beside, self._good), key=lambda rung: rung.seconds, default=None)

    def ratio(self, nominal: bool = False) -> float:
        """Cost of the chosen mesh over that of the `cheapest` rung within the budget; NaN where no rung is.

        Below 1 where the chosen mesh is not within it and costs less than the first that is.
        """
        cheapest = self.cheapest(nominal)
        if cheapest is None:
            return math.nan
        chosen = self.chosen_rung
        if nominal or not self.timed_together:
            return chosen.nominal / cheapest.nominal
        return chosen.seconds / cheapest.seconds

    def affordable(self, nominal: bool = False) -> bool:
        """Whether the chosen mesh costs at most LARGEST_RATIO times the cheapest within the budget."""
        return self.ratio(nominal) <= LARGEST_RATIO
