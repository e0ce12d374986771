"""Counts the pairs on which one flow method is better than each other one, from a folder of `gelflow compare --out`.

A row for each method, each seed by itself: its means, on how many pairs it errs by at most 0.1 px and by more than
1 px, its worst pair, and on how many METHOD is above it in PSNR and SSIM, and nearer to the exact flow in the mean and
in the median pixel. `--scene dots` keeps the pairs whose scene's description has these words, such as "gelsight, dots";
`--without none` leaves such pairs out.
"""

from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

from benchmarks.rows import Row, show
from gelflow.compare.comparison import read_comparison
from gelflow.compare.scores import PairScore, summarise
from gelflow.errors import InputError

BETTER = {"PSNR": "psnr_db", "SSIM": "ssim", "mean px": "endpoint_error_px", "median px": "median_error_px"}


def counted(best: Sequence[PairScore], other: Sequence[PairScore]) -> Row:
    """A method's row; both methods' scores are of the same pairs in the same order."""
    means = summarise(other)[0]
    row: Row = {"method": means.method, "pairs": means.pairs}
    row |= {name: getattr(means, of) for name, of in BETTER.items() if getattr(means, of) is not None}
    errors = [score.endpoint_error_px for score in other if score.endpoint_error_px is not None]
    if errors:
        row |= {"<= 0.1 px": sum(px <= 0.1 for px in errors), "> 1 px": sum(px > 1.0 for px in errors)}
        row["worst px"] = max(errors)
    for name, of in list(BETTER.items())[: 4 if errors else 2]:
        sign = 1 if of in ("psnr_db", "ssim") else -1
        values = [(getattr(a, of), getattr(b, of)) for a, b in zip(best, other, strict=True)]
        row[f"better in {name}"] = sum(sign * a > sign * b for a, b in values)
    return row


def main(argv: list[str]) -> int:
    """Print the table."""
    parser = ArgumentParser("python -m benchmarks counts", description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("method")
    parser.add_argument("--scene", default="")
    parser.add_argument("--without")
    given = parser.parse_args(argv)
    found = read_comparison(given.run / "scores.json")
    if given.method not in found.methods:
        raise InputError(f"{given.run} has no {given.method!r}; it has {', '.join(map(repr, found.methods))}")
    kept = [one for one in found.scores if given.scene in str(one.scene)]
    kept = [one for one in kept if given.without is None or given.without not in str(one.scene)]
    of = {name: [score for score in kept if score.method == name] for name in found.methods}
    rows = [counted(of[given.method], scores) for scores in of.values()]
    show(rows, list(rows[0]), f"{given.method} against the others")
    return 0
