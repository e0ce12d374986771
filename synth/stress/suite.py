"""Running the cases: each in a process that is killed when its budget is spent, then evaluated from what it left.

The results are shown as a table, and written as JSON.
"""

import contextlib
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import version
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from synth import __version__
from synth.dataset.atomic_files import refuse_foreign, replace_file, storage_errors
from synth.stress.cases import EXTREME, Run, all_runs, compared, load_expectations, selected
from synth.stress.check import Result, Verdict, evaluate

if TYPE_CHECKING:
    from rich.table import Table

PACKAGES = ("numpy", "scipy", "warp-lang", "pytetwild")
WORKER = (sys.executable, "-m", "synth.stress.worker")


def run_stress(out: Path, only: Sequence[str] | None, workers: int, as_json: bool, scenes: Path = EXTREME) -> int:
    """Run the cases of a folder of base.toml and expected.toml; write stress.json, or print it.

    `out` is the directory for it, for the meshes, and for a folder per run. `only` are shell patterns of cases or
    groups; cases that others are compared with come along. So many workers run at a time. Returns 0, or 1 when any case
    ended otherwise than written down. InputError for an unknown case, and where expectations or storage are not usable.
    """
    from rich.console import Console

    from synth.progress import progress

    refuse_foreign(out / "stress.json", b'"software"')
    expectations = load_expectations(scenes / "expected.toml")
    runs = selected(all_runs(expectations, (scenes / "base.toml").resolve()), only)
    started = time.perf_counter()
    done = count(1)
    with progress("stress: cases", len(runs)) as advance:
        results = all_results(runs, out, workers, lambda _: advance(next(done), len(runs)))
    verdicts = [evaluate(result, comparable(result, results)) for result in results]
    found = record(verdicts, time.perf_counter() - started)
    replace_file(out / "stress.json", json.dumps(found, indent=1).encode("utf-8"))
    if as_json:
        print(json.dumps(found))
    else:
        Console().print(outcome_table(verdicts))
        print("", *remarks(verdicts), f"{summary(verdicts, found['seconds'])}: {out / 'stress.json'}", sep="\n")
    return 0 if all(verdict.ok for verdict in verdicts) else 1


def all_results(runs: Sequence[Run], out: Path, workers: int, report: Callable[[Result], None]) -> list[Result]:
    """Results in the order of the runs.

    Runs that others are compared with come first and one by one: they make the meshes that the others then read
    (the mesher is not deterministic), and the first of all compiles the solver's kernels.
    """
    with storage_errors(out):
        (out / "meshes").mkdir(parents=True, exist_ok=True)
    names = {other.name for run in runs for other in compared(run, runs)}
    found: dict[str, Result] = {}

    def attempt(run: Run) -> Result:
        return result_of(run, out / "cases" / run.name, out / "meshes")

    for run in runs:
        if run.name in names:
            found[run.name] = attempt(run)
            report(found[run.name])
    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(attempt, run) for run in runs if run.name not in names]
        try:
            for future in as_completed(futures):
                result = future.result()
                found[result.run.name] = result
                report(result)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return [found[run.name] for run in runs]


def result_of(run: Run, folder: Path, meshes: Path, worker: Sequence[str] = WORKER) -> Result:
    """Run one case in a process of its own: a command to which folder and the meshes' cache are appended.

    The folder is emptied, then holds run.json, log.txt and what the process writes.
    """
    with storage_errors(folder):
        if folder.exists():
            refuse_foreign(folder / "run.json", b'"element"', *folder.iterdir())
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
        task = {"element": run.element, "budget_s": run.budget_s, "base": str(run.base)}
        task["case"] = run.case.model_dump(mode="json", by_alias=True)
        (folder / "run.json").write_text(json.dumps(task), encoding="utf-8")
    started, status = time.perf_counter(), None
    with (folder / "log.txt").open("wb") as log, contextlib.suppress(subprocess.TimeoutExpired):
        command = [*worker, str(folder), str(meshes)]
        status = subprocess.run(command, stdout=log, stderr=log, timeout=run.budget_s, check=False).returncode
    seconds = time.perf_counter() - started
    if status is None:
        return Result(run, "hung", "", seconds, {}, {})
    if status != 0 or not (folder / "result.json").is_file():
        return Result(run, "crashed", _last_words(folder / "log.txt", status), seconds, {}, {})
    record: dict[str, Any] = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    arrays: dict[str, np.ndarray] = {}
    if record["outcome"] != "refused":
        with np.load(folder / "states.npz") as states:
            arrays = dict(states)
    return Result(run, record["outcome"], record["message"], seconds, record, arrays)


def comparable(result: Result, results: Sequence[Result]) -> dict[str, Result]:
    """The results that a result is compared with, by their case's name."""
    runs = compared(result.run, [other.run for other in results])
    return {other.run.case.name: other for other in results if other.run in runs}


def _last_words(log: Path, status: int) -> str:
    """What a process that ended badly said last."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    said = lines[-1] if lines else "it said nothing"
    return f"signal {-status}: {said}" if status < 0 else f"exit status {status}: {said}"


def record(verdicts: Sequence[Verdict], seconds: float) -> dict[str, Any]:
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
    """Fits 80 columns. "!" marks a run that ended otherwise than written down, "*" one whose deviation is explained."""
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
