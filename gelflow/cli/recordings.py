"""The command `pairs`."""

from __future__ import annotations

import json
import sys
from collections import Counter
from pathlib import Path
from statistics import quantiles
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gelflow.cli.options import AsJson, Out, whole
from gelflow.errors import InputError, printable

if TYPE_CHECKING:
    from gelflow.data.pairset import PairSet, SourceReport


def pairs(
    inputs: Annotated[
        list[str], Parameter(help="Videos, folders of videos (also below) or images, patterns like 'day1/*.mp4'.")
    ],
    /,
    *,
    out: Out,
    per_video: Annotated[int, Parameter(converter=whole(1), help="Largest number of pairs from one recording.")] = 10,
    min_motion: Annotated[float, Parameter(help="Least motion in px, as the 95th percentile over the image.")] = 2.0,
    max_motion: Annotated[float, Parameter(help="Most motion in px.")] = 60.0,
    min_difference: Annotated[
        float, Parameter(help="Least difference in px between the flows of two pairs of one recording.")
    ] = 1.0,
    frames: Annotated[int, Parameter(converter=whole(1), help="Largest number of frames used of a recording.")] = 40,
    tries: Annotated[int, Parameter(converter=whole(1), help="Largest number of pairs tried of a recording.")] = 200,
    seed: Annotated[int, Parameter(converter=whole(0), help="Seed of the random choice.")] = 0,
    as_json: AsJson = False,
) -> int:
    """Chooses image pairs with enough motion from recordings; continues an interrupted job."""
    from gelflow.data.choose import ChoiceConfig
    from gelflow.data.extract import extract_pairs
    from gelflow.data.pairset import FILE
    from gelflow.terminal import progress

    config = ChoiceConfig(per_video, min_motion, max_motion, min_difference, frames, tries, seed)
    with progress("recordings", not as_json) as advance:

        def step(done: int, total: int, name: str, outcome: SourceReport | str) -> None:
            if isinstance(outcome, str):
                print(printable(f"gelflow: skipped: {outcome}"), file=sys.stderr)
            advance(done, total, name)

        result = extract_pairs(inputs, out, config, step)
    if not result.sources:
        raise InputError(f"none of the {len(result.failures)} recordings can be read; the reasons are in {out / FILE}")
    if not result.pairs:
        reasons: Counter[str] = Counter()
        for report in result.sources.values():
            reasons.update(report.frames_rejected | report.rejected)
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
        raise InputError(
            f"the {len(result.sources)} recordings have no pair with a motion of {config.minimum_motion_px:g} to "
            f"{config.maximum_motion_px:g} px; frames and pairs rejected: {counts or 'none'}; "
            "to try other limits, give another --out"
        )
    _show(result, out, as_json)
    return 1 if result.failures else 0


def _show(result: PairSet, out: Path, as_json: bool) -> None:
    motions = sorted(pair.motion_px for pair in result.pairs)
    deciles = quantiles(motions, n=10, method="inclusive") if len(motions) > 1 else motions
    deciles = [round(value, 1) for value in deciles]
    empty = sum(report.chosen == 0 for report in result.sources.values())
    if as_json:
        answer = {
            "out": str(out),
            "pairs": len(motions),
            "recordings": len(result.sources),
            "without_pairs": empty,
            "failures": result.failures,
            "motion_deciles_px": deciles,
        }
        print(json.dumps(answer))
        return
    counts = f"{empty} without enough motion, {len(result.failures)} unreadable"
    print(f"{len(motions)} pairs from {len(result.sources)} recordings ({counts}) in {out}")
    print(f"motion (95th percentile over the image, px): {motions[0]:.1f} to {motions[-1]:.1f}, deciles {deciles}")
