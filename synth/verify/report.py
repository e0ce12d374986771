"""What verification found: every figure beside its tolerance."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synth.dataset.jsontext import jsonable
from synth.errors import printable

if TYPE_CHECKING:
    from rich.table import Table

_AGREED = (
    "all samples agree with the independent derivation of flow and visibility; "
    "values of other channels are not derived again"
)


@dataclass(frozen=True)
class Check:
    """One figure and its limit, the largest that passes, both in the unit.

    The figure is None where the check does not apply; it then passes, and `detail` says why, as else where the worst
    place is, what was excused, or what is wrong.
    """

    name: str
    figure: float | None
    tolerance: float
    unit: str
    detail: str = ""

    @property
    def passed(self) -> bool:
        """NaN never passes."""
        return self.figure is None or self.figure <= self.tolerance

    @property
    def badness(self) -> tuple[bool, float]:
        """The worst of several is one that failed, or the one nearest to its tolerance."""
        return not self.passed, -1 if self.figure is None else self.figure / (self.tolerance or 1)


@dataclass(frozen=True)
class SampleReport:
    index: int
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        return all(check.passed for check in self.checks)


@dataclass(frozen=True)
class Report:
    path: Path
    samples: tuple[SampleReport, ...]

    @property
    def ok(self) -> bool:
        """Every check of every sample passed, and there was at least one sample."""
        return bool(self.samples) and all(sample.ok for sample in self.samples)

    def record(self) -> dict[str, Any]:
        """JSON-able: path, ok, and for each sample its checks; a figure that is not finite becomes None."""
        samples = [
            {"index": one.index, "ok": one.ok, "checks": [vars(c) | {"passed": c.passed} for c in one.checks]}
            for one in self.samples
        ]
        return {"path": str(self.path), "ok": self.ok, "samples": jsonable(samples)}

    def table(self) -> "Table":
        """A row for each check with its worst figure over the samples; failures are named below in a row each."""
        from rich.table import Table
        from rich.text import Text

        if not self.samples:
            caption = "no finished sample to verify"
        else:
            failed = [str(sample.index) for sample in self.samples if not sample.ok]
            more = f" and {len(failed) - 10} more" if len(failed) > 10 else ""
            caption = f"failed: samples {', '.join(failed[:10])}{more}" if failed else _AGREED
        title = Text(printable(f"{self.path}: {len(self.samples)} samples"), style="table.title")
        table = Table("check", title=title, caption=caption, caption_justify="left")
        for column in ("worst", "tolerance", "sample"):
            table.add_column(column, justify="right")
        table.add_column("")
        every = [(sample.index, check) for sample in self.samples for check in sample.checks]
        for name in dict.fromkeys(check.name for _, check in every):
            rows = [(index, check) for index, check in every if check.name == name]
            index, worst = max(rows, key=lambda row: row[1].badness)
            if worst.figure is None:
                table.add_row(name, "-", "", "", Text(rows[0][1].detail))
                continue
            verdict = "[green]passed" if worst.passed else "[red]FAILED"
            figures = (f"{value:.3g} {worst.unit}" for value in (worst.figure, worst.tolerance))
            table.add_row(name, *figures, str(index), verdict)
        for index, check in every:
            if not check.passed:
                shown = Text(check.name, style="red")
                table.add_row(shown, f"{check.figure:.3g} {check.unit}", "", str(index), Text(printable(check.detail)))
        return table
