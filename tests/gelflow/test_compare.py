"""Comparing methods: the numbers, the files, adding to an earlier comparison, refusals."""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from commands import refused, said
from textures import save, table, write_folder, write_synthetic

from gelflow.arrays import FlowArray, ImageArray
from gelflow.baselines import named_methods
from gelflow.cli import main
from gelflow.compare.run import compare, markdown
from gelflow.compare.scores import evaluate, score_pair, summarise
from gelflow.compare.seeds import grouped
from gelflow.compare.tables import pair_table, summary_table
from gelflow.data import PairDataset, open_all
from gelflow.methods.name import MethodName

SHIFTS = [(3.0, 4.0), (0.0, 0.5), (1.0, 0.0), (2.0, 0.0)]


@dataclass(frozen=True)
class Constant:
    text: str
    u: float
    v: float

    @property
    def name(self) -> MethodName:
        return MethodName.parse(self.text)

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        return np.full((*image1.shape[:2], 2), (self.u, self.v), np.float32)


def test_errors_of_known_flows_are_exact_and_the_true_one_warps_best(tmp_path: Path) -> None:
    dataset = PairDataset(write_synthetic(tmp_path, [(3.0, 4.0), (0.0, 0.5)]))
    scores = evaluate(Constant("zero", 0, 0), dataset)
    assert [(score.endpoint_error_px, score.outliers_1px) for score in scores] == [(5.0, 1.0), (0.5, 0.0)]
    (mean,) = summarise(scores)
    assert (mean.endpoint_error_px, mean.outliers_01px, mean.pairs) == (2.75, 1.0, 2)
    true = evaluate(Constant("true", 3, 4), dataset)[0]
    assert (true.endpoint_error_px, true.calibration) == (0.0, 1.0)
    assert min(true.certain or 0, scores[0].unknown or 0) > 0.5  # sigma knows which one is right
    dataset = PairDataset(write_folder(tmp_path / "plain", {"a": (2.5, -1.5)}))
    best, *others = (evaluate(Constant("x", 2.5 * f, -1.5 * f), dataset)[0] for f in (1, 0, -1, 0.8, 1.2))
    assert best.psnr_db > max(other.psnr_db for other in others)
    assert best.ssim > max(other.ssim for other in others)


def test_files_hold_every_score(tmp_path: Path) -> None:
    dataset = PairDataset(write_synthetic(tmp_path / "data", [(1.0, 0.0), (0.0, 2.0)]))
    methods = named_methods(["none", "farneback", "dis-medium"])
    out = tmp_path / "out"
    written = compare(methods, dataset, out)
    scores = written.scores
    assert written.pairs == dataset.names
    rows = table(out / "scores.csv")
    assert [(row["method"], row["pair"]) for row in rows] == [(str(score.method), score.pair) for score in scores]
    assert float(rows[0]["endpoint_error_px"]) == scores[0].endpoint_error_px == 1.0
    content = json.loads((out / "scores.json").read_text())
    assert [method["method"] for method in content["methods"]] == ["no motion", "Farnebäck", "DIS medium"]
    assert content["methods"][1]["endpoint_error_px"] < content["methods"][0]["endpoint_error_px"] / 3
    assert "| DIS medium |" in (out / "table.md").read_text()


def test_numbers_that_are_not_finite_are_null_and_markers_are_scored_where_there_are_some(tmp_path: Path) -> None:
    """Equal images have an infinite PSNR; an estimate with a gap has no mean error, which is not "no truth"."""
    plain = PairDataset(write_folder(tmp_path / "plain", {"a": (0, 0)}))
    exact = PairDataset(write_synthetic(tmp_path / "exact", [(1, 0)]))
    compare(named_methods(["none"]), plain, tmp_path / "out1")
    text = (tmp_path / "out1" / "scores.json").read_text()
    assert "Infinity" not in text
    assert json.loads(text)["scores"][0]["psnr_db"] is None
    (score,) = compare([Constant("gap", np.nan, 0)], exact, tmp_path / "out2").scores
    assert np.isnan(score.endpoint_error_px)
    folder = write_folder(tmp_path / "marked", {"a": (3, 4), "b": (1, 0)})
    (folder / "a_markers.csv").write_text("x1,y1,x2,y2\n20,20,23,24\n40,30,43,34\n")
    scores = evaluate(Constant("zero", 0, 0), PairDataset(folder))
    assert [score.marker_distance_px for score in scores] == [5.0, None]
    assert pair_table(scores, ["marker_distance_px"], "{:.2f}") == (["method", "a"], [["zero", "5.00"]])
    header, rows = summary_table(grouped(summarise(scores[1:])))
    assert ", ".join(header) == "method, PSNR dB, SSIM, closure px, 90 % px, unknown %, σ ≤ 0.1 px %, ms/pair, core ms"
    assert markdown((header, rows)).splitlines()[1] == "| --- |" + 8 * " ---: |"


def test_earlier_results_are_replaced_on_the_same_data_only(tmp_path: Path) -> None:
    first, second = (PairDataset(write_folder(tmp_path / name, {"a": (1, 0)})) for name in ("first", "second"))
    compare(named_methods(["none"]), first, tmp_path / "out")
    compare(named_methods(["none", "dis-fast"]), first, tmp_path / "out")
    assert "DIS fast" in (tmp_path / "out" / "table.md").read_text()
    refused(r"comparison on .*first.* not on .*second", compare, named_methods(["none"]), second, tmp_path / "out")
    refused("holds other things", compare, named_methods(["none"]), first, tmp_path / "first")


def test_no_method_two_of_one_name_and_broken_pairs_are_refused(tmp_path: Path) -> None:
    dataset = PairDataset(write_folder(tmp_path, {"a": (1, 0), "b": (1, 0)}))
    refused("no method", compare, [], dataset)
    refused("two methods are called 'x'", compare, [Constant("x", 0, 0), Constant("x", 1, 0)], dataset)
    (tmp_path / "b_2.png").write_bytes(b"broken")
    refused(r"b_2\.png", compare, named_methods(["none"]), dataset)


def test_where_nothing_can_be_followed_no_motion_counts_and_exact_flow_is_for_synthetic_pairs(tmp_path: Path) -> None:
    """Not left out: the other pairs' mean would flatter the method."""
    folder = write_folder(tmp_path, {"a": (2, 0), "b": (2, 0)})
    for number in (1, 2):
        save(folder / f"b_{number}.png", np.full((64, 80, 3), 0.5, np.float32))
    tracked, none = compare(named_methods(["lucas-kanade", "none"]), PairDataset(folder)).scores[1::2]
    assert (str(tracked.method), tracked.pair, tracked.ssim) == ("Lucas-Kanade", "b", none.ssim)
    assert math.isinf(tracked.psnr_db)
    dataset = PairDataset(write_synthetic(tmp_path / "exact", [(2.0, 1.0)]))
    (exact,) = evaluate(named_methods(["exact"])[0], dataset)
    (true,) = evaluate(Constant("true", 2, 1), dataset)
    (none,) = evaluate(Constant("none", 0, 0), dataset)
    assert (str(exact.method), exact.endpoint_error_px, exact.outliers_01px) == ("exact flow", 0.0, 0.0)
    assert none.psnr_db + 3 < exact.psnr_db < true.psnr_db  # the strip of 8 of 80 px does move in these images
    plain = PairDataset(write_folder(tmp_path / "plain", {"a": (1, 0)}))
    words = "pair a, exact flow: the pair has no exact flow; leave the method exact out"
    refused(words, evaluate, named_methods(["exact"])[0], plain)


def test_every_nth_pair_of_several_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = [write_synthetic(tmp_path / name, SHIFTS) for name in ("a", "b")]
    command = ["compare", *folders, "--methods", "none", "--json", "--every"]
    scores = json.loads(said(capsys, main, *command, "3"))["scores"]
    assert [(s["pair"], s["motion_px"]) for s in scores] == [("a/000000", 5.0), ("a/000003", 2.0), ("b/000002", 1.0)]
    assert open_all(folders).names[::3] == [s["pair"] for s in scores]
    assert "--every: it is '0'" in said(capsys, main, *command, "0", status=2)


@dataclass(frozen=True)
class Working:
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
    dataset = PairDataset(write_folder(tmp_path, {"a": (1, 0)}))
    waiting, busy = (score_pair(Working(kind), dataset, 0) for kind in (False, True))
    assert waiting.seconds >= 0.1  # Clocks tick at least every 10 ms
    assert waiting.processor_seconds < 0.05
    assert 0.1 <= busy.processor_seconds < 0.15
    assert "core" in busy.device
    assert not busy.on_gpu
