"""The study of the error budget as CSV, Markdown and a few lines for the terminal."""

import csv
import io
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any

from synth.bench.budget_draws import all_draws, misses
from synth.bench.budget_study import BEYOND, Drawn, Study
from synth.bench.budget_tally import GOAL, Tally, tally
from synth.bench.budget_text import number, share, span
from synth.bench.budget_trust import trust
from synth.bench.budget_verdict import LARGEST_RATIO, Rung, Verdict
from synth.bench.press import REPEATS, SHORT_S
from synth.dataset.storage import replace_file
from synth.planning.prediction import SOLVE_GROWTH

NOT_COVERED = (
    "The model itself: the reference solves the same equations with the same contact law. The verification tests "
    "compare those with closed forms.",
    "Flow between two pressed states: its error is the difference of the two states', each of which is judged by "
    "itself.",
    "Meshing, reading files, compiling kernels, the analysis of the sparse pattern (`setup_s` in the CSV), rendering.",
    "Cameras besides the main one; where mirrors show a point twice, the second view of it.",
    "Errors outside the picture, and of points that slide out of it; inside it, what falls between the points that it "
    "is sampled at, 600 to 4000, which is worth a few percent of an error.",
)

PICTURE = (
    "![Measured against predicted error](budget.png)",
    "",
    "*Large: the chosen meshes. Small: the other meshes that were run.*",
    "",
)


def tallies(study: Study, verdicts: Sequence[Verdict], undrawn: Sequence[tuple[str, str]]) -> list[Tally]:
    """Of each scene, then of all where there are several."""
    names = [template.name for template in study.templates]
    found = [
        tally(name, [v for v in verdicts if v.scene == name], sum(scene == name for scene, _ in undrawn))
        for name in names
    ]
    return [*found, tally("all", verdicts, len(undrawn))] if len(names) > 1 else found


def summary(counted: Sequence[Tally]) -> list[str]:
    """The answer, a line each."""
    lines = []
    for one in counted:
        if not one.judged:
            lines.append(f"{one.name}: none of {one.draws} draws can be judged yet")
            continue
        left = one.draws - one.judged
        lines.append(
            f"{one.name}: {one.within} of {one.judged} draws within their target (error over target: median "
            f"{one.median:.2f}, 95th percentile {one.high:.2f}); mesh at most {LARGEST_RATIO:g} times the cheapest "
            f"within it: {one.affordable} of {one.payable} by time, {one.affordable_nominal} by unknowns"
            + (f"; {left} draws not judged" if left else "")
            + f": {'met' if one.met else 'not met'}"
        )
    return lines


def rows(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """A plain dictionary per press that is done."""
    found = []
    for verdict in verdicts:
        own = [Rung(verdict.reference, math.nan, math.nan)] if verdict.reference else []
        for rung in [*own, *verdict.rungs]:
            has_error = not math.isnan(rung.error_px)
            values = {
                **asdict(rung.measurement),
                "chosen": rung.name == verdict.chosen,
                "body": verdict.body,
                "depth_mm": verdict.depth_mm,
                "target_px": verdict.target_px,
                "predicted_px": rung.predicted_px,
                "error_px": rung.error_px,
                "within": rung.within(verdict.target_px) if has_error else None,
            }
            found.append({name: _rounded(value) for name, value in values.items()})
    return found


def _rounded(value: Any) -> Any:
    """Five digits; None for what there is no number of."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.5g}") if math.isfinite(value) else None


def write_report(
    out: Path,
    study: Study,
    draws: Sequence[Drawn],
    verdicts: Sequence[Verdict],
    undrawn: Sequence[tuple[str, str]],
    command: str,
    picture: bool,
) -> None:
    """Write budget.csv and budget.md.

    Args:
        out: directory.
        study: what was asked for.
        draws: of it.
        verdicts: of those draws.
        undrawn: scene and reason of those that no attempt gave.
        command: that made it.
        picture: whether there is one.

    Raises:
        InputError: the storage refuses.
    """
    counted = tallies(study, verdicts, undrawn)
    table, text = rows(verdicts), io.StringIO()
    if table:
        writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    replace_file(out / "budget.csv", text.getvalue().encode("utf-8"))
    lines = [
        "# Does the error budget hold?",
        "",
        f"Made by `{command} --out DIR` on",
        "",
        *_machines(verdicts),
        "",
        *_definitions(study, verdicts),
        "",
        *_answer(counted),
        "",
        *(PICTURE if picture else ()),
        "## Misses",
        "",
        *misses(verdicts, undrawn),
        "",
        "## How far the references can be trusted",
        "",
        *trust(study, verdicts, counted),
        "",
        "## All draws",
        "",
        *all_draws(verdicts),
        "",
        "## What is not covered",
        "",
        _ranges(draws),
        "",
        *(f"- {text}" for text in NOT_COVERED),
        "",
    ]
    replace_file(out / "budget.md", "\n".join(lines).encode("utf-8"))


def _machines(verdicts: Sequence[Verdict]) -> list[str]:
    """What it ran on; a study may have been cut in pieces."""
    presses = [rung.measurement for v in verdicts for rung in v.rungs] + [v.reference for v in verdicts if v.reference]
    lines = []
    for machine, count in Counter(press.machine for press in presses).most_common():
        own = [press for press in presses if press.machine == machine and press.seconds > 0]
        hours = sum(press.seconds for press in own) / 3600
        waiting = median([press.wall_s / press.seconds for press in own] or [math.nan])
        lines.append(
            f"- {machine}: {count} presses, {hours:.2f} h of processor time; wall times are {number(waiting)} times as "
            "long (median)"
        )
    return lines or ["- (nothing has been run yet)"]


def _definitions(study: Study, verdicts: Sequence[Verdict]) -> list[str]:
    reference = study.reference
    return [
        f"{study.draws} draws of each scene with seed {study.seed}, drawn and pressed as `generate` does: the mesh "
        "that `numerics.target_error_px` chooses, load steps, driver and the states that the draw's pairs show.",
        "",
        "**Error**: the root mean square over the picture of the distance in px between where a material point is "
        "seen and where it is seen in the reference, the largest of the states that the draw's pairs show; over the "
        "points that stay in the picture in both (by the same mirror, where there are mirrors), "
        f"{_least_seen(verdicts)} of those that are seen at rest. The reference has elements at least "
        f"{reference.finer:g} times smaller than the chosen mesh's, but at most "
        f"{reference.across} across the contact; {reference.beside[0]} and {reference.beside[1]} beside it, one more "
        "through the thickness than a draw's mesh would have, load steps of "
        f"{reference.step_mm:g} mm, and up to {reference.correction_iterations} iterations in each correction of "
        "penetration.",
        "",
        "**Cost**: processor time of the press in a process of one thread, the median of "
        f"{REPEATS} below {SHORT_S:g} s, without mesh, compilation and the analysis of the sparse pattern; and, as "
        f"times scatter on a busy machine, unknowns to the power {SOLVE_GROWTH:g}. The chosen mesh is compared with "
        f"the cheapest that met the target of those run: the draw's ladder of meshes, of {study.across[0]} to "
        f"{study.across[-1]} elements across, up to {BEYOND} above the chosen one and coarser than the reference. 8x3 "
        "is a mesh of 8 elements across the contact and 3 through the thickness.",
    ]


def _least_seen(verdicts: Sequence[Verdict]) -> str:
    return f"{100 * min([verdict.seen for verdict in verdicts], default=1.0):.0f} % or more"


def _answer(counted: Sequence[Tally]) -> list[str]:
    left = sum(one.unfinished for one in counted[: len(counted) - (len(counted) > 1)])
    lines = ["## Answer", ""]
    if left:
        lines += [f"**Unfinished: presses of {left} draws are still to be run.** What follows is of the others.", ""]
    lines += [
        f"Wanted: {100 * GOAL:g} % of the draws within the target, and {100 * GOAL:g} % at no more than "
        f"{LARGEST_RATIO:g} times the cheapest's cost.",
        "",
        f"| scene | draws | judged | within target | cost ≤ {LARGEST_RATIO:g}x, by time | by unknowns | error / target"
        ": median | 95th percentile | measured / predicted | goals |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for one in counted:
        cells = [one.name, str(one.draws), str(one.judged), share(one.within, one.judged)]
        cells += [share(one.affordable, one.payable), share(one.affordable_nominal, one.payable)]
        cells += [number(one.median), number(one.high), f"{number(one.bias)} (± {number(one.scatter)})"]
        cells.append("met" if one.met else "not met")
        lines.append(f"| {' | '.join(cells)} |")
    return [
        *lines,
        "",
        "Measured over predicted error of the chosen meshes: geometric mean, and standard deviation of the logarithm. "
        f"The goal of cost is counted by time, over the draws of which a rung met the target: "
        f"{counted[-1].payable} of {counted[-1].judged}. Times of different machines do not compare: where the "
        f"presses to be compared ran on several, which are {counted[-1].untimed} of the draws, unknowns count instead.",
        *_not_judged(counted[-1]),
    ]


def _not_judged(every: Tally) -> list[str]:
    """What became of the draws that nothing can be said of, and what the answer would be at worst."""
    open_ones = every.draws - every.unfinished - every.judged - every.replaced
    if not open_ones and not every.replaced:
        return []
    return [
        "",
        f"Not judged are {every.replaced} draws whose press on the chosen mesh stops on its way, so that `generate` "
        f"draws again, and {open_ones} others, most of which have a reference that stops (see below). Were these all "
        f"above their targets, {share(every.within, every.judged + open_ones)} would be within.",
    ]


def _ranges(draws: Sequence[Drawn]) -> str:
    """What the draws are of: elsewhere the model is not tested."""
    scenes = [one.scene for one in draws]
    if not scenes:
        return "There is no draw."
    bodies = Counter(scene.contact.indenter.shape for scene in scenes)
    depth = [100 * scene.motion.depth_mm / scene.sensor.gel.size_mm[2] for scene in scenes]
    return (
        f"The draws are of {', '.join(f'{count} times a {body}' for body, count in bodies.most_common())}; pads of "
        f"{span([scene.sensor.gel.size_mm[2] for scene in scenes])} mm and of "
        f"{span([1 + len(scene.sensor.gel.layers) for scene in scenes])} layers; depths of {span(depth)} % of the "
        f"thickness; friction of {span([scene.contact.friction for scene in scenes])}; elements "
        f"{', '.join(sorted({scene.numerics.element for scene in scenes}))}. Elsewhere the model extrapolates. And not:"
    )
