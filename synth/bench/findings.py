"""What can be read off the benchmark's rows, in sentences whose every number comes from them."""

import numpy as np

from synth.bench.cases import Case
from synth.bench.comparison import Rivalry, rivalry
from synth.bench.fem import Results, Row
from synth.bench.suite import BASE, PLAIN, PLAIN_MESH

STANDARD_FAMILY = "graded P2/P1"
RIVALS = ("graded P1/P1", "fTetWild P2/P1", "uniform P2/P1", "uniform P1/P1", "graded P1", "uniform P1")
VARIED = ("load step", "penalty", "contact points", "factor")


def findings(results: Results) -> list[str]:
    """Markdown paragraphs."""
    cases = [case for case, _ in results.suite.cases]
    return [
        *_in_words(results),
        f"Other meshes and elements against {STANDARD_FAMILY} at the same run time (its errors interpolated between "
        "its runs; runs outside its range of run times left out). A ratio above 1 means that the other is worse:",
        "",
        "| case | family | runs compared | displacement error, ratio | force error, ratio |",
        "|---|---|---|---|---|",
        *(line for case in cases for line in _rivals(results.of(case), case)),
        *_ends(results),
        "",
        f"One parameter changed at a time, from {BASE.name}:",
        "",
        "| case | changed | time | iterations | displacement error, % | force error, % | penetration, mm |",
        "|---|---|---|---|---|---|---|",
        *(line for case in cases for line in _variants(results.of(case), case)),
        "",
        *_driver_and_mesh(results),
    ]


def _in_words(results: Results) -> list[str]:
    """The comparisons below in a sentence each, all cases together."""
    lines = []
    for family, what in (
        ("graded P1/P1", "P1/P1 elements in place of P2/P1, both on graded meshes"),
        ("fTetWild P2/P1", "fTetWild with a sizing field in place of structured graded meshes, both P2/P1"),
        ("uniform P2/P1", "Uniform meshes in place of graded ones, both P2/P1"),
    ):
        all_found = [rivalry(results.of(case), STANDARD_FAMILY, family) for case, _ in results.suite.cases]
        ratios = np.concatenate([found.displacement for found in all_found])
        if len(ratios):
            lines.append(
                f"- {what}: at equal run time {ratios.min():.2g} to {ratios.max():.2g} times the displacement error, "
                f"larger in {(ratios > 1).sum()} of {len(ratios)} comparisons."
            )
    for case, _ in results.suite.cases:
        rows = results.of(case)
        base = next((row for row in rows if row.setting == BASE), None)
        for row in rows:
            if base and row.setting.family == "contact points":
                lines.append(
                    f"- {row.setting.contact_points} contact points a face in place of {BASE.contact_points} "
                    f"({case.name}, {BASE.mesh}): {row.iterations} iterations instead of {base.iterations}, "
                    f"displacement error {row.percent:.2f} % instead of {base.percent:.2f} %, "
                    f"force error {row.force:.2f} % instead of {base.force:.2f} %."
                )
    return [*lines, ""] if lines else []


def _rivals(rows: list[Row], case: Case) -> list[str]:
    lines = []
    for family in RIVALS:
        found = rivalry(rows, STANDARD_FAMILY, family)
        if len(found.seconds):
            lines.append(f"| {case.name} | {family} | {len(found.seconds)} | {_span(found, 0)} | {_span(found, 1)} |")
    return lines


def _span(found: Rivalry, which: int) -> str:
    values = (found.displacement, found.force)[which]
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:.2g}" if len(values) == 1 else f"{low:.2g} to {high:.2g}"


def _ends(results: Results) -> list[str]:
    """Which runs did not complete."""
    short = [row for row in results.rows if not row.complete]
    if not short:
        return ["", "All runs reached the end of their path."]
    return ["", "Runs that ended early:", "", *(
        f"- {row.case.name}, {row.setting.name}: {row.press.trajectory.reason}" for row in short
    )]  # fmt: skip


def _variants(rows: list[Row], case: Case) -> list[str]:
    bases = [row for row in rows if row.setting == BASE]
    changed = [row for row in rows if row.setting.family in VARIED]
    if not bases or not changed:
        return []
    base = bases[0]
    lines = []
    for row in [base, *changed]:
        cells = [case.name, row.setting.detail or "nothing", f"{row.seconds / base.seconds:.2f}x"]
        cells += [f"{row.iterations}", f"{row.percent:.2f}", f"{row.force:.2f}"]
        cells.append(f"{max(state.max_penetration_mm for state in row.press.trajectory.states):.4f}")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _driver_and_mesh(results: Results) -> list[str]:
    """How much of the speed is the driver's and how much the mesh's."""
    lines = []
    for case, _ in results.suite.cases:
        rows = results.of(case)
        plain = next((row for row in rows if row.setting == PLAIN), None)
        uniform = next((r for r in rows if r.setting.family == "uniform P2/P1" and r.setting.mesh == PLAIN_MESH), None)
        base = next((row for row in rows if row.setting == BASE), None)
        if plain and uniform and base:
            lines.append(
                f"Case {case.name}: on the uniform {PLAIN_MESH} mesh the standard driver takes "
                f"{uniform.seconds:.1f} s where the plain one takes {plain.seconds:.1f} s "
                f"({plain.seconds / uniform.seconds:.1f} times), with {uniform.iterations} iterations instead of "
                f"{plain.iterations}; the graded mesh ({BASE.mesh}) takes {base.seconds:.1f} s "
                f"({uniform.seconds / base.seconds:.1f} times less again) with a displacement error of "
                f"{base.percent:.2f} % instead of {uniform.percent:.2f} %."
            )
    return lines
