"""What verification found: every figure beside its tolerance."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synth.dataset.jsontext import jsonable

if TYPE_CHECKING:
    from rich.table import Table

_AGREED = (
    "all samples agree with the independent derivation of flow and visibility; "
    "values of other channels are not derived again"
)


@dataclass(frozen=True)
class Check:
    """One figure and its limit.

    Attributes:
        name: what was checked.
        figure: what was found; None where the check does not apply (it then passes, and `detail` says why).
        tolerance: the largest figure that passes.
        unit: of both.
        detail: where the worst place is, what was excused, or what is wrong.
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


@dataclass(frozen=True)
class SampleReport:
    """All checks of one sample."""

    index: int
    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        return all(check.passed for check in self.checks)


@dataclass(frozen=True)
class Report:
    """All samples of a dataset."""

    path: Path
    samples: tuple[SampleReport, ...]

    @property
    def ok(self) -> bool:
        """Every check of every sample passed, and there was at least one sample."""
        return bool(self.samples) and all(sample.ok for sample in self.samples)

    def record(self) -> dict[str, Any]:
        """JSON-able: path, ok, and for each sample its checks; a figure that is not finite becomes None."""
        samples = [
            {
                "index": sample.index,
                "ok": sample.ok,
                "checks": [
                    {
                        "name": c.name,
                        "figure": c.figure,
                        "tolerance": c.tolerance,
                        "unit": c.unit,
                        "passed": c.passed,
                        "detail": c.detail,
                    }
                    for c in sample.checks
                ],
            }
            for sample in self.samples
        ]
        return {"path": str(self.path), "ok": self.ok, "samples": jsonable(samples)}

    def table(self) -> "Table":
        """A row for each check with its worst figure over the samples; failures are named below in a row each."""
        from rich.table import Table
        from rich.text import Text

        title = Text(f"{self.path}: {len(self.samples)} samples", style="table.title")
        table = Table(title=title, caption=self._caption(), caption_justify="left")
        for column, justify in (("check", "left"), ("worst", "right"), ("tolerance", "right"), ("sample", "right")):
            table.add_column(column, justify=justify)  # type: ignore[arg-type]
        table.add_column("")
        for rows in self._by_name().values():
            applied = [(index, check) for index, check in rows if check.figure is not None]
            if not applied:
                table.add_row(rows[0][1].name, "-", "", "", Text(rows[0][1].detail))
                continue
            index, worst = max(
                applied, key=lambda row: (not row[1].passed, (row[1].figure or 0) / (row[1].tolerance or 1))
            )
            verdict = "[green]passed" if worst.passed else "[red]FAILED"
            table.add_row(
                worst.name, _number(worst.figure, worst.unit), _number(worst.tolerance, worst.unit), str(index), verdict
            )
        for sample in self.samples:
            for check in sample.checks:
                if not check.passed:
                    name, detail = Text(check.name, style="red"), Text(check.detail)
                    table.add_row(name, _number(check.figure, check.unit), "", str(sample.index), detail)
        return table

    def _by_name(self) -> dict[str, list[tuple[int, Check]]]:
        rows: dict[str, list[tuple[int, Check]]] = {}
        for sample in self.samples:
            for check in sample.checks:
                rows.setdefault(check.name, []).append((sample.index, check))
        return rows

    def _caption(self) -> str:
        if not self.samples:
            return "no finished sample to verify"
        failed = [sample.index for sample in self.samples if not sample.ok]
        return f"failed: samples {_list(failed)}" if failed else _AGREED


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3g} {unit}"


def _list(indices: Sequence[int]) -> str:
    shown = ", ".join(str(i) for i in indices[:10])
    return shown + (f" and {len(indices) - 10} more" if len(indices) > 10 else "")
