"""What the report of the error budget says of its references."""

import math
from collections.abc import Sequence

import numpy as np

from synth.bench.budget_study import Study
from synth.bench.budget_tally import Tally
from synth.bench.budget_text import cell, number, share
from synth.bench.budget_verdict import Verdict
from synth.bench.fem import LARGEST_PENETRATION_MM
from synth.bench.report import RATE


def trust(study: Study, verdicts: Sequence[Verdict], counted: Sequence[Tally]) -> list[str]:
    """Status, penetration and uncertainty of the references, in Markdown.

    Args:
        study: that they belong to.
        verdicts: of all draws.
        counted: of each scene, and perhaps of all.
    """
    lines = [
        "A reference's own error is not known. If errors fall with the power "
        f"{RATE:g} of the spacing, its difference from the press on the finest mesh below it, with the draw's own load "
        "steps and driver, tells how large it is; the second column has it added to the errors. If moreover the errors "
        "of chosen mesh and reference had one shape, their difference would be smaller than the former by a known "
        "factor; the third column has the errors that this makes of the measured ones. Where the two errors are "
        "independent, the true one is smaller than measured.",
        "",
        "| scene | within target | with the reference's own error added | extrapolated |",
        "|---|---|---|---|",
        *(
            f"| {one.name} | {share(one.within, one.judged)} | {share(one.added, one.judged)} | "
            f"{share(one.extrapolated, one.judged)} |"
            for one in counted
        ),
        "",
        "| scene | references run | complete | own error / target: median | largest | penetration left, mm: median | "
        f"largest | above {LARGEST_PENETRATION_MM:g} mm |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for template in study.templates:
        own = [verdict for verdict in verdicts if verdict.scene == template.name]
        lines.append(f"| {template.name} | {' | '.join(_of_scene(own))} |")
    incomplete = [v for v in verdicts if v.reference is not None and not v.reference.complete]
    if incomplete:
        lines += ["", "References that are not complete, whose draws are not judged:", ""]
        lines += [f"- {v.scene}, draw {v.index}: {v.reference.status}: {cell(v.reference.reason)}"
                  for v in incomplete if v.reference]  # fmt: skip
    deep = [v for v in verdicts if v.reference is not None and v.reference.penetration_mm > LARGEST_PENETRATION_MM]
    if deep:
        lines += [
            "",
            "Penetration is an error of the contact law, which the difference of two meshes need not show. It is above "
            f"{LARGEST_PENETRATION_MM:g} mm in the references of:",
            "",
        ]
        lines += [f"- {v.scene}, draw {v.index} ({v.body}, {v.depth_mm:.2f} mm deep): "
                  f"{v.reference.penetration_mm:.3f} mm, {_left(v)}" for v in deep if v.reference]  # fmt: skip
    return lines


def _of_scene(verdicts: Sequence[Verdict]) -> list[str]:
    references = [verdict.reference for verdict in verdicts if verdict.reference is not None]
    doubts = [v.doubt_px / v.target_px for v in verdicts if v.judged and not math.isnan(v.doubt_px)]
    left = [reference.penetration_mm for reference in references if reference.complete]
    return [
        str(len(references)),
        str(sum(reference.complete for reference in references)),
        *(number(float(value)) for value in ((np.median(doubts), max(doubts)) if doubts else (math.nan, math.nan))),
        *(
            f"{value:.4f}" if left else "–"
            for value in ((np.median(left), max(left)) if left else (math.nan, math.nan))
        ),
        str(sum(value > LARGEST_PENETRATION_MM for value in left)),
    ]


def _left(verdict: Verdict) -> str:
    if not verdict.judged:
        return "not judged"
    return f"{verdict.chosen_rung.measurement.penetration_mm:.3f} mm in the chosen mesh's"
