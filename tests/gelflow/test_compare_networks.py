"""Networks in a comparison: RAFT and GelFlow beside each other, speed, fine-tuning on the pairs, the Pareto front."""

import csv
import json
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from textures import write_folder
from waves import Shifts, small

from gelflow.arrays import FlowArray, ImageArray
from gelflow.cli import main
from gelflow.compare.plots import pareto_front
from gelflow.compare.scores import evaluate
from gelflow.compare.speed import network_speed
from gelflow.data import open_pairs
from gelflow.models.raft import RAFT
from gelflow.models.weights import read_metadata
from gelflow.train import train


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A GelFlow network after one step."""
    config = small(steps=1, batch_size=1, learning_rate=1e-4)
    return train(config, Shifts(1, 64, 1.0, seed=1), None, tmp_path_factory.mktemp("run")).weights


@pytest.fixture(scope="module")
def raft(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("raft") / "small.pth"
    torch.manual_seed(0)
    torch.save(RAFT(large=False).state_dict(), path)
    return path


def test_all_kinds_of_networks_share_one_table(
    weights: Path, raft: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0), "b": (0, 1)})
    out = tmp_path / "out"
    arguments = ["compare", str(folder), "--methods", "none,lucas-kanade", "--weights", f"mine={weights}", "--weights",
                 str(raft), "--ft", "2", "--device", "cpu", "--out", str(out)]  # fmt: skip
    assert main(arguments) == 0
    text = capsys.readouterr().out
    names = ["no motion", "Lucas-Kanade", "mine", "RAFT small", "mine+ft"]
    assert all(name in text for name in names)
    with (out / "scores.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(dict.fromkeys(row["method"] for row in rows)) == names
    assert "strata" not in rows[0]
    table = (out / "table.md").read_text()
    apart = table.split("Fine-tuned on these very pairs")
    assert "| mine+ft |" not in apart[0]
    assert "| mine+ft |" in apart[1]
    networks = json.loads((out / "scores.json").read_text())["networks"]
    assert set(networks) == {"mine", "RAFT small", "mine+ft"}
    assert all(one["pairs_per_second"] > 0 and one["size"] == [64, 80] for one in networks.values())
    assert (out / "work_precision.png").stat().st_size > 5000
    # The fine-tuned copy lies beside the results: the same command uses it again, another number of steps goes on.
    tuned = tmp_path / "out_ft" / "mine" / "weights.safetensors"
    assert read_metadata(tuned)["step"] == "2"
    before = load_file(tuned)
    again = ["compare", str(folder), "--methods", "", "--weights", f"mine={weights}", "--batch", "0", "--device", "cpu",
             "--out", str(out)]  # fmt: skip
    assert main([*again, "--ft", "2"]) == 0
    after = load_file(tuned)
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert main([*again, "--ft", "3"]) == 0
    assert read_metadata(tuned)["step"] == "3"


def test_fine_tuning_needs_a_place_and_a_network(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    assert main(["compare", str(folder), "--weights", str(weights), "--ft", "5"]) == 2
    assert main(["compare", str(folder), "--ft", "5", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.count("--ft 5: needs --weights of GelFlow, and --out") == 2
    tail = ["--ft", "5", "--ft-config", "paper", "--out", str(tmp_path / "out")]
    assert main(["compare", str(folder), "--weights", str(weights), *tail]) == 2
    assert "for another number of scales" in capsys.readouterr().err


def test_fine_tuning_changes_the_copy_only_and_lowers_its_loss(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    before = weights.read_bytes()
    out = tmp_path / "out"
    arguments = ["compare", str(folder), "--methods", "", "--weights", f"mine={weights}", "--batch", "0", "--json"]
    assert main([*arguments, "--ft", "40", "--out", str(out)]) == 0
    assert weights.read_bytes() == before
    scores = {one["method"]: one for one in json.loads(capsys.readouterr().out)["methods"]}
    assert scores["mine+ft"]["psnr_db"] > scores["mine"]["psnr_db"]


@dataclass
class Counting:
    """Test double: counts its calls."""

    name: str = "counting"
    calls: int = 0

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        self.calls += 1
        return 0 * image1[..., :2]


def test_the_first_call_is_not_timed(tmp_path: Path) -> None:
    method = Counting()
    scores = evaluate(method, open_pairs(write_folder(tmp_path, {"a": (1, 0), "b": (0, 1)})))
    assert (len(scores), method.calls) == (2, 3)


def test_the_front_holds_what_no_other_beats_in_both() -> None:
    points = [(3.0, 1.0), (1.0, 5.0), (2.0, 6.0), (2.0, 2.0), (4.0, 1.0), (1.0, 7.0)]
    assert pareto_front(points) == [1, 3, 0]
    assert pareto_front([]) == []


class Hungry(torch.nn.Module):
    """Holds 64 MiB while it runs."""

    def forward(self, image1: torch.Tensor, image2: torch.Tensor) -> torch.Tensor:
        return torch.full((16 * 2**20,), float(image1.mean()), device=image1.device).sum()


def test_speed_sees_the_memory_of_a_pass() -> None:
    speed = network_speed(Hungry(), (64, 64), batch=2, warmup=1, repeats=2)
    assert speed.pairs_per_second > 0
    if speed.memory_mib is not None:  # Linux
        # The tensor itself; what else the process takes meanwhile (code of the kernels, buffers) stays below as much.
        assert 60 < speed.memory_mib < 128
