"""The suite's results as a table, CSV, JSON and Markdown."""

import csv
import io
import json
import os
import platform
import shlex
from collections.abc import Sequence
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synth import __version__
from synth.dataset.storage import replace_file
from synth.stress.cases import Expectation, Expectations
from synth.stress.check import Verdict

if TYPE_CHECKING:
    from rich.table import Table

PACKAGES = ("numpy", "scipy", "warp-lang", "pytetwild")
COLUMNS = ("case", "element", "group", "outcome", "expected", "verdict", "wall_s", "budget_s", "states_asked",
           "states", "depth_mm", "shear_x_mm", "shear_y_mm", "twist_deg", "force_x_n", "force_y_n", "force_z_n",
           "torque_z_nmm", "penetration_mm", "min_jacobian", "residual", "iterations", "tetrahedra", "worst_shape",
           "message", "broken", "because")  # fmt: skip


def row(verdict: Verdict) -> dict[str, Any]:
    """One run as plain values."""
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
        "software": software(),
        "cases": [row(verdict) for verdict in verdicts],
    }


def software() -> dict[str, str]:
    """Versions that results may depend on."""
    return {"synth": __version__, "python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def summary(verdicts: Sequence[Verdict], seconds: float) -> str:
    """One line."""
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


def write_report(
    out: Path, verdicts: Sequence[Verdict], expectations: Expectations, only: Sequence[str] | None, seconds: float
) -> None:
    """Write stress.csv, stress.json and stress.md.

    Raises:
        InputError: the storage refuses.
    """
    replace_file(out / "stress.csv", _csv(verdicts).encode("utf-8"))
    replace_file(out / "stress.json", json.dumps(record(verdicts, seconds), indent=1).encode("utf-8"))
    replace_file(out / "stress.md", _markdown(out, verdicts, expectations, only, seconds).encode("utf-8"))


def _csv(verdicts: Sequence[Verdict]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for verdict in verdicts:
        joined = {k: "; ".join(v) if isinstance(v, list) else v for k, v in row(verdict).items()}
        writer.writerow(joined)
    return text.getvalue()


def _numbers(verdict: Verdict) -> list[str]:
    """Force, penetration, det F, iterations and seconds as they stand in a table."""
    found = verdict.measured
    shown = []
    if found:
        shown = [
            f"{found['force_z_n']:.4g}",
            f"{found['penetration_mm']:.2g}",
            f"{found['min_jacobian']:.3f}",
            f"{found['iterations']:.0f}",
        ]
    return [*(shown or ["", "", "", ""]), f"{verdict.result.wall_s:.1f}"]


def _remark(verdict: Verdict) -> str:
    """What is to be said of a run: what is broken, why it deviates, or the reason it gave."""
    deviation = verdict.result.run.case.deviation
    if verdict.broken:
        return "; ".join(verdict.broken)
    return deviation.because if deviation and verdict.deviates else verdict.result.message


def _markdown(
    out: Path, verdicts: Sequence[Verdict], expectations: Expectations, only: Sequence[str] | None, seconds: float
) -> str:
    command = shlex.join(["python", "-m", "synth", "stress", *(x for name in only or () for x in ("--only", name))])
    packages = ", ".join(f"{name} {number}" for name, number in software().items())
    lines = [
        "# Stiff and extreme cases",
        "",
        f"Made by `{command} --out DIR` ({packages}; {os.cpu_count()} cores). {summary(verdicts, seconds)}.",
        "",
        "Each run is the scene `scenes/extreme/base.toml` with the changes that `scenes/extreme/expected.toml` lists "
        "beside the outcome, written down before the case was first run. It has a process and a time budget of its "
        "own, and is judged from what it left: it must have ended by itself and without a traceback, with a reason "
        "where it is not "
        "complete; every recorded state must be finite, converged to its tolerance, and have det F > 0, also when "
        "computed again from the stored displacements.",
        "",
        "![Contact surfaces after the last recorded state](stress.png)",
    ]
    for group, members in groupby(verdicts, key=lambda verdict: verdict.result.run.case.group):
        lines += ["", f"## {group[0].upper()}{group[1:]}", ""]
        lines += ["| case | expected | ended | N | penetration, mm | det F | iter. | s |", "|---" * 8 + "|"]
        told: list[str] = []
        listed = list(members)
        for verdict in listed:
            case = verdict.result.run.case
            ended = verdict.result.outcome + ("" if verdict.word == "as expected" else f" (**{verdict.word}**)")
            cells = (f"`{verdict.result.run.name}`", _expected(case), ended, *_numbers(verdict))
            lines.append(f"| {' | '.join(cells)} |")
        for name in dict.fromkeys(verdict.result.run.case.name for verdict in listed):
            told += _told([verdict for verdict in listed if verdict.result.run.case.name == name])
        lines += ["", *told]
    lines += ["", "## What is not covered", "", *(f"- {text}" for text in expectations.not_covered), ""]
    return "\n".join(lines)


def _expected(case: Expectation) -> str:
    """Outcome and figures of an entry in a few words."""
    parts = [" or ".join(case.outcome)]
    parts += [f"{name} {low:g}..{high:g}" for name, (low, high) in case.bounds.items()]
    if case.compare is not None:
        same = "" if case.compare.displacement is None else f"displacement within {case.compare.displacement:g}"
        ratio = "" if case.compare.force_ratio is None else "force x {:.6g}..{:.6g}".format(*case.compare.force_ratio)
        parts.append(f"of `{case.compare.with_case}`: {', '.join(filter(None, (same, ratio)))}")
    return "; ".join(parts)


def _told(verdicts: Sequence[Verdict]) -> list[str]:
    """One case in sentences: why it is there, what was changed, and what it said."""
    case = verdicts[0].result.run.case
    changed = [f"`--set '{text}'`" for text in case.set]
    changed += [f"mesh: {case.mesh}"] if case.mesh != "as made" else []
    changed += [f"indenter file: {case.surface}"] if case.surface else []
    lines = [f"- **{case.name}**: {case.why}.{' ' if changed else ''}{', '.join(changed)}"]
    for verdict in verdicts:
        if remark := _remark(verdict):
            lines.append(f"  - {verdict.result.run.element}, {verdict.word}: {remark}".replace("\n", " / "))
    return lines
