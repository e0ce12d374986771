"""Adding methods to an earlier comparison, taking a part of the pairs, and what is measured beside the errors."""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from test_compare import Constant
from textures import write_folder, write_synthetic

from gelflow.arrays import FlowArray, ImageArray
from gelflow.cli import main
from gelflow.compare.comparison import read_comparison
from gelflow.compare.run import compare
from gelflow.compare.scores import score_pair
from gelflow.data import join, open_pairs
from gelflow.errors import InputError

SHIFTS = [(3.0, 4.0), (0.0, 0.5), (1.0, 0.0), (2.0, 0.0)]


def test_a_comparison_read_back_is_the_same(tmp_path: Path) -> None:
    """Fails with the bins left out of the file."""
    dataset = open_pairs(write_synthetic(tmp_path / "data", SHIFTS))
    written = compare([Constant("zero", 0, 0), Constant("right", 3, 4)], dataset, tmp_path / "out")
    again = read_comparison(tmp_path / "out" / "scores.json")
    assert again.data == written.data
    assert again.pairs == dataset.names
    assert again.strata == written.strata
    assert [score.strata for score in again.scores] == [()] * 8
    assert [(s.method, s.pair, s.endpoint_error_px, s.motion_px) for s in again.scores] == [
        (s.method, s.pair, s.endpoint_error_px, s.motion_px) for s in written.scores
    ]
    assert again.to_json() == written.to_json()


def test_numbers_that_are_not_finite_come_back(tmp_path: Path) -> None:
    """Equal images have an infinite PSNR; an estimate with a gap has no mean error, which is not "no truth"."""
    plain = open_pairs(write_folder(tmp_path / "plain", {"a": (0, 0)}))
    compare([Constant("zero", 0, 0)], plain, tmp_path / "out1")
    (score,) = read_comparison(tmp_path / "out1" / "scores.json").scores
    assert score.psnr_db == math.inf
    assert score.endpoint_error_px is None
    compare([Constant("gap", np.nan, 0)], open_pairs(write_synthetic(tmp_path / "exact", [(1, 0)])), tmp_path / "out2")
    (score,) = read_comparison(tmp_path / "out2" / "scores.json").scores
    assert math.isnan(score.endpoint_error_px or 0.0)


def test_methods_are_added_and_scored_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = str(write_synthetic(tmp_path / "data", SHIFTS)), tmp_path / "out"
    assert main(["compare", folder, "--methods", "none,dis-fast", "--out", str(out)]) == 0
    before = read_comparison(out / "scores.json")
    assert main(["compare", folder, "--methods", "farneback,none", "--out", str(out), "--add"]) == 0
    after = read_comparison(out / "scores.json")
    assert after.methods == ["DIS fast", "Farnebäck", "no motion"]
    assert after.strata["DIS fast"] == before.strata["DIS fast"]
    assert [s for s in after.scores if s.method == "DIS fast"] == [s for s in before.scores if s.method == "DIS fast"]
    table = (out / "table.md").read_text()
    assert table.index("| DIS fast |") < table.index("| Farnebäck |")
    assert all((out / name).stat().st_size > 5000 for name in ("table.png", "work_precision.png", "strata.png"))
    capsys.readouterr()
    assert main(["compare", folder, "--methods", "none", "--add"]) == 2
    assert "--add: give the folder of the earlier comparison as --out" in capsys.readouterr().err


def test_a_moved_copy_of_the_data_is_the_same_data_and_other_pairs_are_not(tmp_path: Path) -> None:
    """Fails without the check of the true motion: the last folder's pairs have the same names."""
    first = open_pairs(write_synthetic(tmp_path / "first", [(1.0, 0.0), (0.0, 2.0)]))
    moved = open_pairs(write_synthetic(tmp_path / "moved", [(1.0, 0.0), (0.0, 2.0)]))
    longer = open_pairs(write_synthetic(tmp_path / "longer", [(1.0, 0.0), (0.0, 2.0), (3.0, 0.0)]))
    other = open_pairs(write_synthetic(tmp_path / "other", [(1.0, 0.0), (0.0, 2.5)]))
    plain = open_pairs(write_folder(tmp_path / "plain", {"000000": (1, 0), "000001": (0, 2)}))
    out = tmp_path / "out"
    compare([Constant("a", 0, 0)], first, out)
    result = compare([Constant("b", 0, 0)], moved, out, add=True)
    assert result.methods == ["a", "b"]
    assert result.data == (first.source, moved.source)
    kept = (out / "scores.json").read_bytes()
    for dataset, words in ((longer, r"\(2 pairs\), not on .*longer \(3 pairs\)"), (other, "these are other pairs"),
                           (plain, "these are other pairs")):  # fmt: skip
        with pytest.raises(InputError, match=words):
            compare([Constant("c", 0, 0)], dataset, out, add=True)
    assert (out / "scores.json").read_bytes() == kept


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"data": ["x"]}', '{"data": [], "scores": [{"method": "a"}], "strata": {}, "networks": {}}']
)
def test_scores_that_cannot_be_read_are_named(content: str, tmp_path: Path) -> None:
    dataset = open_pairs(write_folder(tmp_path / "data", {"a": (1, 0)}))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "scores.json").write_text(content)
    with pytest.raises(InputError, match=r"scores\.json: not the scores of a comparison of this version"):
        compare([Constant("a", 0, 0)], dataset, tmp_path / "out", add=True)


def test_every_nth_pair_of_several_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [write_synthetic(tmp_path / name, SHIFTS) for name in ("a", "b")]
    command = ["compare", *map(str, folders), "--methods", "none", "--json"]
    assert main([*command, "--every", "3"]) == 0
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert [(s["pair"], s["motion_px"]) for s in scores] == [("a/000000", 5.0), ("a/000003", 2.0), ("b/000002", 1.0)]
    assert join([open_pairs(folder) for folder in folders]).names[::3] == [s["pair"] for s in scores]
    assert main([*command, "--every", "0"]) == 2
    assert "--every 0" in capsys.readouterr().err


@dataclass(frozen=True)
class Working:
    """Test double: waits, or keeps a processor busy, for as long."""

    busy: bool
    name: str = "working"

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        clock = time.process_time if self.busy else time.perf_counter
        end = clock() + 0.1
        while clock() < end:
            if not self.busy:
                time.sleep(0.01)
        return 0 * image1[..., :2]


def test_processor_time_is_that_of_the_work(tmp_path: Path) -> None:
    """Fails with perf_counter in place of process_time."""
    dataset = open_pairs(write_folder(tmp_path, {"a": (1, 0)}))
    waiting, busy = (score_pair(Working(kind), dataset, 0) for kind in (False, True))
    # Sleeping costs well under a ms a call; clocks tick at least every 10 ms.
    assert waiting.seconds >= 0.1
    assert waiting.processor_seconds < 0.05
    assert 0.1 <= busy.processor_seconds < 0.15
    assert "core" in busy.device
    assert not busy.on_gpu
