"""Error of the finite-element solver against its run time: runs a suite and gathers rows."""

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import numpy as np

from synth.bench.accuracy import Answer, Errors, answer, errors, worst
from synth.bench.cases import Case
from synth.bench.press import Press, pressed, ready_stepper
from synth.bench.setting import Fine, MeshKind, Setting
from synth.bench.shares import time_shares
from synth.bench.suite import Suite
from synth.mesh import PadMesh
from synth.simulate.driver import Driver
from synth.simulate.newton import MAX_ITERATIONS

Say = Callable[[str], None]
PATIENT = Driver(correction_iterations=MAX_ITERATIONS)
"""Of the references, whose corrections of penetration are not to be dropped; one that wanders is, all the same."""
LARGEST_PENETRATION_MM = 0.01
"""A reference above it is not used. Corrected states have 0.005 mm; without, it was 0.06 mm and the force 4 % low."""


@dataclass(frozen=True)
class Row:
    """One setting on one case.

    Attributes:
        case, setting: which.
        press: what it took; its trajectory tells how it ended.
        errors: against the case's reference, per recorded state.
        mesh_s: time to make the mesh.
    """

    case: Case
    setting: Setting
    press: Press
    errors: Errors
    mesh_s: float

    @property
    def seconds(self) -> float:
        """Processor time of the press alone."""
        return self.press.seconds

    @property
    def percent(self) -> float:
        """Worst error of the displacement, NaN where a judged state was not reached."""
        return worst(self.errors.percent, self.case)

    @property
    def px(self) -> float:
        """Worst error of the displacement along the face."""
        return worst(self.errors.px, self.case)

    @property
    def force(self) -> float:
        """Worst error of the normal and, with friction, the tangential force, %."""
        errors = np.fmax(self.errors.normal, self.errors.tangential)  # NaN only where both are
        return worst(errors, self.case)

    @property
    def iterations(self) -> int:
        """Newton's, in all."""
        return sum(state.newton_iterations for state in self.press.trajectory.states)

    @property
    def complete(self) -> bool:
        """Whether all states were reached."""
        return self.press.trajectory.status == "complete"


@dataclass(frozen=True)
class Trust:
    """How far a case's reference can be trusted.

    Attributes:
        difference: of a coarser mesh against it.
        seconds: of the two presses.
        unknowns: of the reference.
    """

    difference: Errors
    seconds: tuple[float, float]
    unknowns: int


@dataclass(frozen=True)
class Results:
    """All of one run of the benchmark.

    Attributes:
        suite: what was asked for.
        rows: of all cases.
        trust: by the case's name.
        shares: part of the solver to share of the time of `suite.profiled`.
        px_per_mm: image scale.
        seconds: of the whole run.
    """

    suite: Suite
    rows: tuple[Row, ...]
    trust: dict[str, Trust]
    shares: dict[str, float]
    px_per_mm: float
    seconds: float

    def of(self, case: Case) -> list[Row]:
        """The rows of a case."""
        return [row for row in self.rows if row.case == case]


def measure(suite: Suite, px_per_mm: float, processes: int = 2, say: Say = lambda _: None) -> Results:
    """Run a suite: references first, then the cases, side by side; of a case one setting after another.

    Args:
        suite: what to run.
        px_per_mm: image scale that errors are given in.
        processes: how many presses run at once; 1 runs them in this process.
        say: told what was done.
    """
    started = time.perf_counter()
    cases = [case for case, _ in suite.cases]
    count = min(processes, os.cpu_count() or 1)
    with ProcessPoolExecutor(count, get_context("spawn")) if count > 1 else nullcontext() as pool:  # no fork: Warp
        at_once: Callable[..., Any] = pool.map if pool else map
        references = _references(cases, (suite.reference, suite.check), at_once, say)
        trust = {
            case.name: Trust(
                errors(check.found, good.found, case, px_per_mm), (good.seconds, check.seconds), good.unknowns
            )
            for case, (good, check) in zip(cases, references, strict=True)
        }
        rows: list[Row] = []
        settings, answers = [of_case for _, of_case in suite.cases], [good.found for good, _ in references]
        for found in at_once(_rows, cases, settings, answers, [px_per_mm] * len(cases)):
            rows += found
            for row in found:
                say(f"{row.case.name}: {row.setting.name}: {row.seconds:.2f} s, {row.percent:.2f} %, {row.force:.2f} %")
    stepper = ready_stepper(cases[0], suite.profiled, suite.profiled.mesh.mesh(cases[0]))
    shares = time_shares(stepper.run)
    return Results(suite, tuple(rows), trust, shares, px_per_mm, time.perf_counter() - started)


def _rows(case: Case, settings: Sequence[Setting], reference: Answer, px_per_mm: float) -> list[Row]:
    """All settings of a case."""
    pressed(case, settings[0], Fine(2, 2).mesh(case), 0.0)  # compiles what is not yet compiled
    meshes: dict[MeshKind, tuple[PadMesh, float]] = {}
    rows = []
    for setting in settings:
        if setting.mesh not in meshes:
            began = time.perf_counter()
            mesh = setting.mesh.mesh(case)
            meshes[setting.mesh] = (mesh, time.perf_counter() - began)
        mesh, mesh_s = meshes[setting.mesh]
        press = pressed(case, setting, mesh)
        rows.append(Row(case, setting, press, errors(answer(press.trajectory), reference, case, px_per_mm), mesh_s))
    return rows


@dataclass(frozen=True)
class Solved:
    """A reference."""

    found: Answer
    seconds: float
    unknowns: int


def _references(
    cases: Sequence[Case], meshes: Sequence[Fine], at_once: Callable[..., Any], say: Say
) -> list[tuple[Solved, ...]]:
    """For each case what `_solve` gives on each of the meshes."""
    jobs = [(case, mesh) for mesh in meshes for case in cases]  # the longest first
    solved: list[Solved] = []
    for (case, mesh), one in zip(jobs, at_once(_solve, *zip(*jobs, strict=True)), strict=True):
        say(f"{case.name}: reference, {mesh}: {one.seconds:.1f} s")
        solved.append(one)
    return [tuple(solved[k :: len(cases)]) for k in range(len(cases))]


def _solve(case: Case, mesh: Fine) -> Solved:
    """A reference.

    Raises:
        RuntimeError: it did not reach its end, or a correction of penetration was dropped.
    """
    press = pressed(case, Setting("reference", mesh, driver=PATIENT), mesh.mesh(case), 0.0)
    ended, deepest = press.trajectory.status, max(state.max_penetration_mm for state in press.trajectory.states)
    if ended != "complete" or deepest > LARGEST_PENETRATION_MM:
        raise RuntimeError(
            f"no errors can be given: the reference of {case.name} on {mesh} is {ended}, {deepest:.2g} mm in the ball"
        )
    return Solved(answer(press.trajectory), press.seconds, press.unknowns)
