"""The draws of the study of the error budget in tables: those that failed with the reason, and all of them."""

from collections.abc import Sequence

from synth.bench.budget_text import cell, number
from synth.bench.budget_verdict import Verdict


def misses(verdicts: Sequence[Verdict], undrawn: Sequence[tuple[str, str]]) -> list[str]:
    """A table of the draws that failed, and why, in Markdown.

    Args:
        verdicts: of all draws; unfinished ones are left out.
        undrawn: scene and reason of draws that no attempt gave.
    """
    found = [f"| {scene} | – | – | – | – | – | – | – | not drawn: {cell(reason)} |" for scene, reason in undrawn]
    for verdict in verdicts:
        why = [] if verdict.unfinished else _why(verdict)
        if why:
            found.append(f"| {' | '.join(_cells(verdict))} | {cell('; '.join(why))} |")
    if not found:
        return ["None."]
    return [
        "Draws above their target, dearer than wanted by either measure of cost, or that cannot be judged:",
        "",
        "| scene | draw | indenter | depth, mm | mesh | predicted, px | error, px | target, px | why |",
        "|---|---|---|---|---|---|---|---|---|",
        *found,
    ]


def _cells(verdict: Verdict) -> list[str]:
    error = number(verdict.error_px) if verdict.judged else "–"
    return [verdict.scene, str(verdict.index), verdict.body, f"{verdict.depth_mm:.2f}", verdict.chosen,
            number(verdict.predicted_px), error, f"{verdict.target_px:g}"]  # fmt: skip


def _why(verdict: Verdict) -> list[str]:
    """What is wrong with a draw, in words; empty where nothing is."""
    if not verdict.judged:
        return [verdict.trouble]
    why = []
    cheapest = verdict.cheapest()
    if not verdict.within:
        factor = verdict.error_px / verdict.predicted_px
        if verdict.predicted_px > verdict.target_px:
            why.append("the finest mesh was predicted to be above the target")
        else:
            why.append(f"above the target: the model predicted {factor:.1f} times too little")
        left = verdict.chosen_rung.measurement.penetration_mm
        why.append(f"{left:.3f} mm of penetration left in the chosen mesh's states")
        if cheapest is None:
            why.append("no mesh that was run met the target")
        elif cheapest.name != verdict.chosen:
            why.append(f"{cheapest.name} would have, {number(1 / verdict.ratio())} times the time")
    elif cheapest is not None and not (verdict.affordable() and verdict.affordable(nominal=True)):
        predicted = cheapest.predicted_px
        why.append(
            f"{verdict.ratio():.1f} times the time ({verdict.ratio(nominal=True):.1f} by unknowns) of "
            f"{cheapest.name}, whose error is {number(cheapest.error_px)} px and was predicted as "
            f"{number(predicted)} px"
        )
    return why


def all_draws(verdicts: Sequence[Verdict]) -> list[str]:
    """A table of every draw, in Markdown."""
    lines = [
        "Errors of the rungs in px, the chosen one's in bold; the ratio is of the chosen mesh's cost to the cheapest "
        "within the target, by time / by unknowns; penetration is what is left in the chosen mesh's judged states.",
        "",
        "| scene | draw | indenter | depth, mm | mesh | predicted, px | error, px | target, px | rungs | ratio | "
        "penetration, mm |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for verdict in verdicts:
        rungs = [f"{'**' if r.name == verdict.chosen else ''}{r.name}: {number(r.error_px)}"
                 f"{'**' if r.name == verdict.chosen else ''}" for r in verdict.rungs]  # fmt: skip
        cells = [*_cells(verdict), ", ".join(rungs)]
        if verdict.judged:
            cells.append(f"{number(verdict.ratio())} / {number(verdict.ratio(nominal=True))}")
            cells.append(f"{verdict.chosen_rung.measurement.penetration_mm:.4f}")
        else:
            cells += ["–", "–"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines
