"""The suite's results as a table, CSV and JSON."""

import csv
import io
import json
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synth import __version__
from synth.dataset.storage import replace_file
from synth.stress.check import Verdict

if TYPE_CHECKING:
    from rich.table import Table

PACKAGES = ("numpy", "scipy", "warp-lang", "pytetwild")
COLUMNS = ("case", "element", "group", "outcome", "expected", "verdict", "wall_s", "budget_s", "states_asked",
           "states", "depth_mm", "shear_x_mm", "shear_y_mm", "twist_deg", "force_x_n", "force_y_n", "force_z_n",
           "torque_z_nmm", "penetration_mm", "min_jacobian", "residual", "iterations", "tetrahedra", "worst_shape",
           "message", "broken", "because")  # fmt: skip


def row(verdict: Verdict) -> dict[str, Any]:
    result, case = verdict.result, verdict.result.run.case
    return {
        "case": case.name,
        "element": result.run.element,
        "group": case.group,
        "why": case.why,
        "set": list(case.set),
        "mesh_variant": case.mesh,
        "surface_variant": case.surface,
        "outcome": result.outcome,
        "expected": list(case.outcome),
        "verdict": verdict.word,
        "ok": verdict.ok,
        "wall_s": round(result.wall_s, 2),
        "budget_s": result.run.budget_s,
        **{name: result.record.get(name) for name in ("states_asked", "nodes", "tetrahedra", "worst_shape", "mesh")},
        **verdict.measured,
        "message": result.message,
        "broken": list(verdict.broken),
        "because": case.deviation.because if case.deviation and verdict.deviates else "",
    }


def record(verdicts: Sequence[Verdict], seconds: float) -> dict[str, Any]:
    """The whole suite, JSON-able."""
    return {
        "ok": all(verdict.ok for verdict in verdicts),
        "seconds": round(seconds, 1),
        "software": {
            "synth": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in PACKAGES},
        },
        "cases": [row(verdict) for verdict in verdicts],
    }


def summary(verdicts: Sequence[Verdict], seconds: float) -> str:
    count = {word: sum(verdict.word == word for verdict in verdicts) for word in ("explained", "OTHERWISE")}
    text = f"{len(verdicts)} runs in {seconds / 60:.1f} min: {len(verdicts) - sum(count.values())} as expected"
    return f"{text}, {count['explained']} otherwise with an explanation, {count['OTHERWISE']} otherwise"


def outcome_table(verdicts: Sequence[Verdict]) -> "Table":
    """For the terminal; fits 80 columns. "!" marks what ended otherwise than written down, "*" an explained one."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("case", "ended", "", box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("N", "mm", "det F", "iter.", "s"):
        table.add_column(heading, justify="right")
    for verdict in verdicts:
        style = "red" if verdict.broken else "yellow" if verdict.deviates else None
        mark = "!" if verdict.broken else "*" if verdict.deviates else ""
        cells = (verdict.result.run.name, verdict.result.outcome, mark, *_numbers(verdict))
        table.add_row(*map(escape, cells), style=style)
    return table


def remarks(verdicts: Sequence[Verdict]) -> list[str]:
    """A line for every run that is not as expected."""
    return [f"{v.result.run.name}: {v.word}: {_remark(v)}" for v in verdicts if v.word != "as expected"]


def write_report(out: Path, verdicts: Sequence[Verdict], found: dict[str, Any]) -> None:
    """Write stress.csv and stress.json, the latter from `record`; InputError where the storage refuses."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for verdict in verdicts:
        writer.writerow({k: "; ".join(v) if isinstance(v, list) else v for k, v in row(verdict).items()})
    replace_file(out / "stress.csv", text.getvalue().encode("utf-8"))
    replace_file(out / "stress.json", json.dumps(found, indent=1).encode("utf-8"))


def _numbers(verdict: Verdict) -> list[str]:
    """Force, penetration, det F, iterations and seconds as they stand in the table; blanks without a state."""
    forms = {"force_z_n": ".4g", "penetration_mm": ".2g", "min_jacobian": ".3f", "iterations": ".0f"}
    found = verdict.measured
    return [*(f"{found[key]:{form}}" if found else "" for key, form in forms.items()), f"{verdict.result.wall_s:.1f}"]


def _remark(verdict: Verdict) -> str:
    """What is to be said of a run: what is broken, why it deviates, or the reason it gave."""
    deviation = verdict.result.run.case.deviation
    if verdict.broken:
        return "; ".join(verdict.broken)
    return deviation.because if deviation and verdict.deviates else verdict.result.message
