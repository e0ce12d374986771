"""`synth bench budget`: over random draws of scenes, does the chosen mesh keep the error budget, and at what cost?"""

import math
import os
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from synth import __version__
from synth.errors import InputError

if TYPE_CHECKING:
    from synth.bench.budget_press import Measurement
    from synth.bench.budget_store import Store
    from synth.bench.budget_study import Drawn, Job, Study
    from synth.bench.budget_verdict import Verdict

PACKAGES = ("numpy", "scipy", "warp-lang", "pypardiso")


def run_budget(
    scenes: Sequence[str],
    out: Path,
    draws: int,
    seed: int,
    reference: int,
    workers: int,
    minutes: float | None,
    as_json: bool,
) -> int:
    """Measure the draws' errors and costs and write OUT/budget.csv, budget.md and budget.png.

    The same command goes on where it stopped (see `synth.bench.budget_store`).

    Args:
        scenes: names or files; none: the shipped scenes.
        out: directory.
        draws: of each scene.
        seed: of the draws.
        reference: most elements across the contact of what errors are measured against; only coarser rungs are run.
        workers: presses that run at once, each in a process of its own.
        minutes: begin no press that is not expected to end within them; those that have begun are waited for.
        as_json: print the counts instead of the summary.

    Returns:
        0; or 1 when presses are still to do, or a share of draws is below what is wanted.

    Raises:
        InputError: a scene is wrong or has no budget, the directory holds another study, the storage refuses.
    """
    from synth.bench.budget_study import Reference, Study
    from synth.dataset.storage import report_folder
    from synth.scene.template import load_scene, shipped_scenes
    from synth.simulate.resolution import LADDER

    finer = tuple(across for across in LADDER if across < reference)
    if len(finer) < 2:
        raise InputError(f"--reference {reference}: must be finer than two meshes, {LADDER[0]} and {LADDER[1]} across")
    if minutes is not None and not minutes > 0:
        raise InputError(f"--minutes = {minutes:g}: must be above 0")
    deadline = math.inf if minutes is None else time.monotonic() + 60 * minutes
    templates = tuple(load_scene(scene) for scene in scenes or shipped_scenes())
    command = f"python -m synth bench budget --draws {draws} --seed {seed} --reference {reference}"
    command += "".join(f" --scene {shlex.quote(Path(scene).name)}" for scene in scenes)
    study = Study(templates, seed, draws, finer, Reference(reference))
    report_folder(out, "budget")
    return study_budget(study, out, command, workers, deadline, as_json)


def study_budget(
    study: "Study",
    out: Path,
    command: str,
    workers: int = 1,
    deadline: float = math.inf,
    as_json: bool = False,
) -> int:
    """Run what is left of a study and write what is known; see `run_budget`.

    Args:
        study: what is asked for.
        out: directory.
        command: for the report.
        workers: presses that run at once.
        deadline: of `time.monotonic`, after which no press is to end.
        as_json: print the counts instead of the summary.
    """
    from synth.bench.budget_picture import can_draw, measured_against_predicted
    from synth.bench.budget_pool import presses
    from synth.bench.budget_report import summary, tallies, write_report
    from synth.bench.budget_schedule import Schedule
    from synth.bench.budget_store import Store
    from synth.bench.budget_study import jobs
    from synth.dataset.jsontext import to_line
    from synth.dataset.storage import replace_file

    with Store(out, study) as store:
        draws, undrawn = _drawn(study)
        every = jobs(study, draws)
        known = store.known(draws)
        left = {job: work for job, work in every.items() if job not in known}
        done = len(every) - len(left)
        for pressed in presses(study, Schedule(left, deadline), workers, _machine(workers)):
            store.keep(pressed)
            done += 1
            one = pressed.measurement
            known[one.job] = one
            _say(f"{one.scene} {one.index}: {one.rung}: {one.status}, {one.seconds:.1f} s ({done} of {len(every)})")
        verdicts = [_verdict(study, one, known, store) for one in draws]
        picture = can_draw() and any(verdict.judged for verdict in verdicts)
        if picture:
            replace_file(out / "budget.png", measured_against_predicted(verdicts))
        elif not can_draw():
            _say(
                "there is no matplotlib here, so that budget.png is not drawn; the same command draws it where there is"
            )
        write_report(out, study, draws, verdicts, undrawn, command, picture)
    counted = tallies(study, verdicts, undrawn)
    if as_json:
        print(to_line([{**vars(one), "met": one.met} for one in counted]), end="")
    else:
        print("\n".join([*summary(counted), f"written: {out / 'budget.md'}"]))
    if done < len(every):
        _say(f"unfinished: {done} of {len(every)} presses are done; give the same command again to go on")
        return 1
    return 0 if all(one.met for one in counted) else 1


def _drawn(study: "Study") -> tuple[list["Drawn"], list[tuple[str, str]]]:
    """The draws, and scene and reason of those that no attempt gave."""
    from synth.bench.budget_study import drawn

    draws, undrawn = [], []
    for template in study.templates:
        for index in range(study.draws):
            try:
                draws.append(drawn(template, study.seed, index))
            except InputError as error:
                undrawn.append((template.name, str(error)))
    return draws, undrawn


def _verdict(study: "Study", one: "Drawn", measured: "Mapping[Job, Measurement]", store: "Store") -> "Verdict":
    """What is known of a draw."""
    from synth.bench.budget_field import picture_errors
    from synth.bench.budget_study import REFERENCE, Job
    from synth.bench.budget_verdict import Rung, Verdict

    name = one.template.name
    asked = [Job(name, one.index, rung) for rung in [REFERENCE, *study.rungs(one)]]
    known = [measured[job] for job in asked if job in measured]
    reference = next((measurement for measurement in known if measurement.rung == REFERENCE), None)
    truth = store.field(reference.job) if reference is not None and reference.complete else None
    rungs, seen = [], 1.0
    for measurement in known:
        if measurement.rung != REFERENCE:
            error = math.nan
            if truth is not None and measurement.complete:
                errors, shares = picture_errors(store.field(measurement.job), truth, one.scene)
                error = float(errors.max())
                seen = min(seen, float(shares.min()))
            rungs.append(Rung(measurement, error, one.predicted_px(measurement.spacing_mm)))
    return Verdict(
        scene=name,
        index=one.index,
        body=one.scene.contact.indenter.shape,
        depth_mm=one.scene.motion.depth_mm,
        target_px=one.target_px,
        chosen=one.chosen_rung,
        predicted_px=one.chosen.error_px,
        rungs=tuple(rungs),
        reference=reference,
        seen=seen,
        missing=len(asked) - len(known),
    )


def _machine(workers: int) -> str:
    """Processor, cores, what works on them, and versions; for a machine that has no mesher, too."""
    from synth.bench.machine import processor
    from synth.simulate.linear import has_pardiso

    parts = [f"{processor()}, {os.cpu_count()} cores, {workers} presses at once"]
    parts += ["Pardiso" if has_pardiso() else "SuperLU, no Pardiso", f"synth {__version__}"]
    for package in PACKAGES:
        try:
            parts.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(parts)


def _say(line: str) -> None:
    print(f"synth: {line}", file=sys.stderr, flush=True)
