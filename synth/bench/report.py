"""The benchmark's results as CSV, JSON, Markdown and a few lines for the terminal."""

import csv
import io
import math
from pathlib import Path
from statistics import median
from typing import Any

from synth.bench.cases import GEL, INDENTER, Case
from synth.bench.comparison import cheapest, pareto_front, speed_up
from synth.bench.fem import Results, Row
from synth.bench.findings import STANDARD_FAMILY, findings
from synth.bench.machine import machine_line
from synth.bench.picture import work_precision
from synth.bench.press import REPEATS, SHORT_S
from synth.bench.suite import PLAIN_MESH, WIDE
from synth.dataset.storage import replace_file

GOALS = ((2.0, 1.0, 8.0), (1.0, 1.0, 4.0))
"""Displacement error and force error (%) and the speed-up over the plain driver that the held case is to reach; the
other cases are to reach half the speed-up."""
QUANTITIES = (
    ("percent", "error_percent"),
    ("px", "error_px"),
    ("normal", "normal_force_percent"),
    ("tangential", "tangential_force_percent"),
)
"""Fields of `Errors` and their columns."""
RATE = 1.6
"""Power of the spacing with which the displacement's error falls, as in `synth.simulate.resolution`."""
NOT_COVERED = (
    "Other shapes, thicknesses, materials and layers: one ball on one pad. Random draws of the shipped scenes are "
    "another test.",
    "The model itself: the reference solves the same equations with the same contact law. The verification tests "
    "compare those with closed forms.",
    "Meshing, reading files, compiling kernels, and the analysis of the sparse pattern (column `setup_s` of the CSV): "
    "structured graded meshes of one `across` share one pattern, fTetWild makes a new one for every mesh.",
    "More than one thread or process, and GPUs.",
    "Scatter of fTetWild: it is not deterministic, and each of its settings was meshed once.",
)


def record(results: Results) -> list[dict[str, Any]]:
    """A plain dictionary per row."""
    found = []
    for case, _ in results.suite.cases:
        rows = results.of(case)
        front = pareto_front(rows)
        found += [_plain(row, rows, row in front) for row in rows]
    return found


def _plain(row: Row, rows: list[Row], on_front: bool) -> dict[str, Any]:
    setting, press, states = row.setting, row.press, row.press.trajectory.states
    values: dict[str, Any] = {
        "case": row.case.name,
        "family": setting.family,
        "mesh": str(setting.mesh),
        "detail": setting.detail,
        "element": setting.element,
        "contact_points": setting.contact_points,
        "step_mm": setting.numerics.max_step_mm,
        "penalty": setting.numerics.penalty,
        "loose_tolerance": setting.driver.loose,
        "extrapolation": setting.driver.extrapolate,
        "factor": "float32" if setting.driver.single_precision else "float64",
        "kept_factors": setting.driver.keep_factors,
        "unknowns": press.unknowns,
        "status": press.trajectory.status,
        "seconds": press.seconds,
        "wall_s": press.wall_s,
        "repeats": press.repeats,
        "speed_up": speed_up(row, rows),
        "mesh_s": row.mesh_s,
        "setup_s": press.setup_s,
        "newton_iterations": row.iterations,
        "pareto": on_front,
        "worst_error_percent": row.percent,
        "worst_error_px": row.px,
        "worst_force_percent": row.force,
        "penetration_mm": max(state.max_penetration_mm for state in states),
        "min_jacobian": min(state.min_jacobian for state in states),
        "slip_ratio": states[-1].slip_ratio,
    }
    for k in range(len(row.case.poses)):
        for name, column in QUANTITIES:
            values[f"{column}_{k + 1}"] = float(getattr(row.errors, name)[k])
    return {name: _rounded(value) for name, value in values.items()}


def _rounded(value: Any) -> Any:
    """Five digits; None for what there is no number of."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.5g}") if math.isfinite(value) else None


def write_results(out: Path, results: Results, command: str) -> None:
    """Write fem.csv, fem.png and fem.md.

    Raises:
        InputError: the storage refuses.
    """
    rows = record(results)
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace_file(out / "fem.csv", text.getvalue().encode("utf-8"))
    replace_file(out / "fem.png", work_precision(results))
    replace_file(out / "fem.md", _markdown(results, command).encode("utf-8"))


def summary(results: Results) -> list[str]:
    """Which goals are met, in lines."""
    return [
        f"{case.name}: displacement within {limit:g} %, force within {force:g} %, {need:g} times as fast as the plain "
        f"driver: {_told(results, case, limit, force, need)}"
        for case, limit, force, need in _goals(results)
    ]


def _goals(results: Results) -> list[tuple[Case, float, float, float]]:
    first = results.suite.cases[0][0]
    return [
        (case, limit, force, need if case is first else need / 2)
        for case, _ in results.suite.cases
        for limit, force, need in GOALS
    ]


def _told(results: Results, case: Case, limit: float, force: float, need: float) -> str:
    rows = results.of(case)
    row = cheapest(rows, STANDARD_FAMILY, limit, force)
    if row is None:
        wide = cheapest(rows, WIDE.family, limit, force)
        beyond = "" if wide is None else f"; {wide.setting.family}: {_answer(wide)}, {speed_up(wide, rows):.1f}x"
        return f"no setting that scenes choose is that accurate{beyond}"
    factor = speed_up(row, rows)
    if math.isnan(factor):
        return f"{row.setting.mesh}, {row.seconds:.2f} s; the plain driver did not complete"
    return f"{'met' if factor >= need else 'not met'}: {_answer(row)}, {factor:.1f}x"


def _answer(row: Row) -> str:
    return f"{row.setting.mesh}, {row.percent:.2f} %, force {row.force:.2f} %, {row.seconds:.2f} s"


def _markdown(results: Results, command: str) -> str:
    size = " x ".join(f"{length:g}" for length in GEL.size_mm)
    waiting = median(row.press.wall_s / row.seconds for row in results.rows)
    lines = [
        "# Error of the solver against its run time",
        "",
        f"Made by `{command} --out DIR` in {results.seconds / 60:.1f} min ({machine_line()}).",
        "",
        f"A gel pad of {size} mm, bonded at its back, E = {GEL.youngs_modulus_kpa / 1000:g} MPa, Poisson ratio "
        f"{GEL.poisson_ratio:g}; a rigid ball of {INDENTER.radius_mm:g} mm radius. Cases:",
        "",
        *(f"- **{case.name}**: {_case_line(case)}" for case, _ in results.suite.cases),
        "",
        "Displacement errors are relative L2 norms over the contact face, in % of the reference's displacement, and "
        "root mean squares of the motion along the face in px of a GelSight Mini's image "
        f"({results.px_per_mm:.1f} px/mm); "
        "the worst of the judged states counts, and so for the force, normal or, with friction, tangential (length of "
        f"the vectors' difference). Time is processor time of the press, the median of {REPEATS} below {SHORT_S:g} s. "
        "The solver uses one thread, so that on an idle core this is the wall time; in this run the wall time was "
        f"{waiting:.2f} times as long (median; column `wall_s` of the CSV). Mesh, compiled kernels and the analysis of "
        "the sparse pattern exist before. Settings ran one after another in one process.",
        "",
        "![Work-precision plot](fem.png)",
        "",
        "## Targets",
        "",
        "The plain driver solves every step of 0.25 mm to 1e-6 from the last state (with friction, carried along with "
        "the ball to first order, without which shear takes some thirty times the iterations), with every tangent "
        f"factorised, in double precision, on the uniform {PLAIN_MESH} P2/P1 mesh; element, contact, line search and "
        "the correction of recorded states are the standard ones. The fastest setting of the standard family (P2/P1 on "
        "graded meshes) within the limits:",
        "",
        "| case | displacement | force | wanted | result |",
        "|---|---|---|---|---|",
        *(
            f"| {case.name} | ≤ {limit:g} % | ≤ {force:g} % | {need:g}x | {_told(results, case, limit, force, need)} |"
            for case, limit, force, need in _goals(results)
        ),
        "",
        "## What the runs say",
        "",
        *findings(results),
        "",
        "## Where the time goes",
        "",
        f"One press of the {results.suite.cases[0][0].name} case, {results.suite.profiled.name}, under a profiler "
        "(which adds a few percent):",
        "",
        "| part | share |",
        "|---|---|",
        *(f"| {part} | {100 * share:.0f} % |" for part, share in results.shares.items()),
        "",
        "## How far the references can be trusted",
        "",
        *_trust(results),
        "",
        "## All runs",
        *(line for case, _ in results.suite.cases for line in _table(results, case)),
        "",
        "## What is not covered",
        "",
        *(f"- {text}" for text in NOT_COVERED),
        "",
    ]
    return "\n".join(lines)


def _case_line(case: Case) -> str:
    motion = case.motion
    x, y = motion.position_mm
    where = "centred" if (x, y) == (0, 0) else f"at ({x:g}, {y:g}) mm"
    poses = [f"{motion.depth_mm:g} mm deep"]
    if any(motion.shear_mm) or motion.twist_deg:
        poses.append(
            f"sheared by ({motion.shear_mm[0]:g}, {motion.shear_mm[1]:g}) mm and twisted by {motion.twist_deg:g}°"
        )
    for pose in motion.then:
        text = f"{pose.depth_mm:g} mm deep"
        if any(pose.shear_mm) or pose.twist_deg:
            text = f"({pose.shear_mm[0]:g}, {pose.shear_mm[1]:g}) mm and {pose.twist_deg:g}°"
        poses.append(text)
    friction = f"friction {case.friction:g}" if case.friction else "frictionless"
    return f"{where}, {friction}; {', then '.join(poses)}; judged: {', '.join(case.poses[k] for k in case.judged)}."


def _trust(results: Results) -> list[str]:
    suite = results.suite
    lines = [
        f"A case's reference is a press on a structured mesh of P2/P1 elements, {suite.reference}, everything else as "
        f"in the standard setting. It differs from the same with {suite.check} by:",
        "",
        "| case | displacement, % | px | normal force, % | tangential force, % | unknowns | s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, trust in results.trust.items():
        parts = (trust.difference.percent, trust.difference.px, trust.difference.normal, trust.difference.tangential)
        cells = [" / ".join(_number(value) for value in part) for part in parts]
        lines.append(f"| {name} | {' | '.join(cells)} | {trust.unknowns} | {trust.seconds[0]:.0f} |")
    ratio = suite.reference.across / suite.check.across
    growth = ratio**RATE
    return [
        *lines,
        "",
        f"If the error falls with the power {RATE:g} of the spacing, the reference's own is {1 / (growth - 1):.1f} "
        f"times this difference where both meshes err alike, and {1 / math.hypot(1, growth):.1f} times where their "
        "errors are independent. Errors of settings that come near that are no more than estimates.",
    ]


def _table(results: Results, case: Case) -> list[str]:
    rows = results.of(case)
    front = pareto_front(rows)
    lines = [
        "",
        f"### {case.name[0].upper()}{case.name[1:]}",
        "",
        f"Errors at {' / '.join(case.poses)}; bold: on the Pareto front of time and displacement error.",
        "",
        "| setting | unknowns | s | speed-up | iterations | displacement, % | px | normal force, % |"
        + (" tangential force, % |" if case.friction else "")
        + " penetration, mm |",
        "|---" * (10 if case.friction else 9) + "|",
    ]
    for row in rows:
        errors, states = row.errors, row.press.trajectory.states
        parts = [errors.percent, errors.px, errors.normal] + ([errors.tangential] if case.friction else [])
        name = f"**{row.setting.name}**" if row in front else row.setting.name
        if not row.complete:
            name += f" ({row.press.trajectory.status})"
        factor = speed_up(row, rows)
        cells = [name, str(row.press.unknowns), f"{row.seconds:.2f}", "" if math.isnan(factor) else f"{factor:.1f}"]
        cells += [str(row.iterations), *(" / ".join(_number(value) for value in part) for part in parts)]
        cells.append(f"{max(state.max_penetration_mm for state in states):.4f}")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2g}" if value < 10 else f"{value:.0f}"
