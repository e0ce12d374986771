"""The scripts around data and comparisons: counts, loss_order and synthetic_set."""

from pathlib import Path

import pytest
import torch

from benchmarks import synthetic_set
from benchmarks.counts import counted
from benchmarks.loss_order import fitted
from gelflow.compare.scores import PairScore
from gelflow.ops.pyramid import enlarge_flow


def score(method: str, psnr_db: float, error_px: float | None) -> PairScore:
    """Of one pair; what counts is made up, the rest is nothing."""
    made_up = {"psnr_db": psnr_db, "ssim": psnr_db / 100, "endpoint_error_px": error_px, "median_error_px": error_px}
    spent = {"seconds": 0.0, "processor_seconds": 0.0, "device": "cpu", "on_gpu": False}
    return PairScore(method=method, pair="pair", scene="gelsight, dots", **made_up, **spent)


def test_counts_of_made_up_scores() -> None:
    """A higher PSNR is better and a smaller error; equal is not better."""
    best = [score("a", 30, 0.05), score("a", 20, 0.3), score("a", 25, 1.5)]
    other = [score("b", 29, 0.05), score("b", 21, 0.4), score("b", 24, 1.6)]
    row = counted(best, other)
    expected = {"method": "b", "pairs": 3, "<= 0.1 px": 1, "> 1 px": 1, "worst px": 1.6, "better in PSNR": 2,
                "better in SSIM": 2, "better in mean px": 2}  # fmt: skip
    assert row | expected == row
    without = counted([score("a", 30, None)], [score("b", 29, None)])
    assert without["better in PSNR"] == 1
    assert not any("px" in name for name in without)


def test_the_fitted_coarse_flow_is_found_again() -> None:
    """Where the full flow is an enlarged one; the means over blocks, its start, are off by tenths of a pixel."""
    torch.manual_seed(0)
    true = torch.randn(1, 2, 6, 7, dtype=torch.float64)
    flow, known = enlarge_flow(true, 2, (24, 28)), torch.ones(1, 1, 24, 28, dtype=torch.float64)
    start = torch.nn.functional.avg_pool2d(flow, 4) / 4
    assert (start - true).abs().max() > 0.1
    # The squared residual falls to 1e-10 of the first: errors to some 1e-5 of the start's.
    torch.testing.assert_close(fitted(flow, known, start, 2), true, atol=1e-4, rtol=0)


def test_the_synthetic_set_has_every_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def synth(command: list[str]) -> int:
        commands.append(command)
        return int("digit" in command)

    monkeypatch.setattr(synthetic_set, "synth", synth)
    assert synthetic_set.main(["--out", str(tmp_path), "--workers", "2"]) == 1  # the worst of all
    assert {"digit", "gelsight_mini", "tac3d"} <= {command[command.index("--scene") + 1] for command in commands}
    assert all(command[-2:] == ["--workers", "2"] for command in commands)
