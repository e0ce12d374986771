"""What a comparison's tables do not count: `python docs/counts.py RUN METHOD [--scene WORDS] [--without WORDS]`

RUN is the folder of `gelflow compare --out`. A row for each method, seeds apart: its means, on how many pairs it errs
by at most 0.1 px and by more than 1 px, its worst pair, and on how many METHOD is above it in PSNR and SSIM, nearer to
the exact flow in the mean and in the median pixel. `--scene dots` keeps the pairs whose scene names it, as "gelsight,
dots" does; `--without none` leaves such pairs out.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from gelflow.compare.comparison import read_comparison
from gelflow.compare.report import markdown
from gelflow.compare.scores import PairScore, summarise

BETTER = {"PSNR": "psnr_db", "SSIM": "ssim", "mean px": "endpoint_error_px", "median px": "median_error_px"}


def counted(best: Sequence[PairScore], other: Sequence[PairScore]) -> list[str]:
    """A method's row; both methods' scores are of the same pairs in the same order."""
    means = summarise(other)[0]
    row = [means.method, str(means.pairs), f"{means.psnr_db:.2f}", f"{means.ssim:.4f}"]
    errors = [score.endpoint_error_px for score in other if score.endpoint_error_px is not None]
    if errors:
        row += [f"{means.endpoint_error_px:.4f}", f"{means.median_error_px:.4f}"]
        row += [str(sum(px <= 0.1 for px in errors)), str(sum(px > 1.0 for px in errors)), f"{max(errors):.4f}"]
    for name in list(BETTER.values())[: 4 if errors else 2]:
        values = [(getattr(a, name), getattr(b, name)) for a, b in zip(best, other, strict=True)]
        larger = name in ("psnr_db", "ssim")
        row.append(f"{sum((a > b) if larger else (a < b) for a, b in values)} of {len(values)}")
    return row


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("method")
    parser.add_argument("--scene", default="")
    parser.add_argument("--without")
    given = parser.parse_args()
    found = read_comparison(given.run / "scores.json")
    if given.method not in found.methods:
        parser.error(f"{given.run} has no {given.method!r}; it has {', '.join(map(repr, found.methods))}")
    kept = [
        score
        for score in found.scores
        if given.scene in str(score.scene) and (given.without is None or given.without not in str(score.scene))
    ]
    of = {name: [score for score in kept if score.method == name] for name in found.methods}
    exact = any(score.endpoint_error_px is not None for score in kept)
    head = ["method", "pairs", "PSNR dB", "SSIM"]
    head += ["mean px", "median px", "at most 0.1 px", "above 1 px", "worst px"] if exact else []
    head += [f"{given.method} better in {what}" for what in list(BETTER)[: 4 if exact else 2]]
    print(markdown((head, [counted(of[given.method], scores) for scores in of.values()])))


if __name__ == "__main__":
    main()
