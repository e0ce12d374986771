"""The suite's results as a table and JSON."""

from collections.abc import Sequence
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from synth import __version__
from synth.stress.check import Verdict

if TYPE_CHECKING:
    from rich.table import Table

PACKAGES = ("numpy", "scipy", "warp-lang", "pytetwild")


def record(verdicts: Sequence[Verdict], seconds: float) -> dict[str, Any]:
    """The whole suite, JSON-able."""
    return {
        "ok": all(verdict.ok for verdict in verdicts),
        "seconds": round(seconds, 1),
        "software": {"synth": __version__, **{name: version(name) for name in PACKAGES}},
        "cases": [_row(verdict) for verdict in verdicts],
    }


def _row(verdict: Verdict) -> dict[str, Any]:
    result, case = verdict.result, verdict.result.run.case
    return {
        "case": case.name,
        "element": result.run.element,
        **case.model_dump(mode="json", include={"group", "why", "set", "surface"}),
        "outcome": result.outcome,
        "expected": list(case.outcome),
        "verdict": verdict.word,
        "ok": verdict.ok,
        "wall_s": round(result.wall_s, 2),
        "budget_s": result.run.budget_s,
        **{name: result.record.get(name) for name in ("states_asked", "nodes", "tetrahedra", "worst_shape")},
        **verdict.measured,
        "message": result.message,
        "broken": list(verdict.broken),
    }


def outcome_table(verdicts: Sequence[Verdict]) -> "Table":
    """For the terminal; fits 80 columns. "!" marks what ended otherwise than written down, "*" an explained one."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("case", "ended", "", box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("N", "mm", "det F", "iter.", "s"):
        table.add_column(heading, justify="right")
    forms = {"force_z_n": ".4g", "penetration_mm": ".2g", "min_jacobian": ".3f", "iterations": ".0f"}
    for verdict in verdicts:
        mark, style = {"OTHERWISE": ("!", "red"), "explained": ("*", "yellow")}.get(verdict.word, ("", None))
        numbers = [f"{verdict.measured[key]:{form}}" if verdict.measured else "" for key, form in forms.items()]
        result = verdict.result
        cells = (result.run.name, result.outcome, mark, *numbers, f"{result.wall_s:.1f}")
        table.add_row(*map(escape, cells), style=style)
    return table


def remarks(verdicts: Sequence[Verdict]) -> list[str]:
    """A line for every run that is not as expected."""
    found = []
    for verdict in verdicts:
        deviation = verdict.result.run.case.deviation
        if verdict.broken:
            found.append(f"{verdict.result.run.name}: {verdict.word}: {'; '.join(verdict.broken)}")
        elif verdict.deviates and deviation is not None:
            found.append(f"{verdict.result.run.name}: {verdict.word}: {deviation.because}")
    return found


def summary(verdicts: Sequence[Verdict], seconds: float) -> str:
    count = {word: sum(verdict.word == word for verdict in verdicts) for word in ("explained", "OTHERWISE")}
    text = f"{len(verdicts)} runs in {seconds / 60:.1f} min: {len(verdicts) - sum(count.values())} as expected"
    return f"{text}, {count['explained']} otherwise with an explanation, {count['OTHERWISE']} otherwise"
