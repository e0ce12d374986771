"""Networks in a comparison: RAFT and GelFlow, speed, fine-tuning on the pairs, registration, the Pareto front."""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refused, said
from safetensors.torch import load_file
from test_cli import fails
from textures import table, write_folder, write_synthetic
from waves import Shifts, random_weights, same_weights, small

import gelflow.compare.run
import gelflow.models.gelflow
from gelflow.arrays import FlowArray, ImageArray
from gelflow.cli import main
from gelflow.compare.plots import pareto_front
from gelflow.compare.run import compare
from gelflow.compare.scores import evaluate
from gelflow.compare.speed import Speed, network_speed
from gelflow.config import REGISTRATIONS, ModelConfig, MotionConfig, Registration, RegistrationConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.data import PairDataset, open_all
from gelflow.files.exr import read_flow
from gelflow.methods.learned import Learned
from gelflow.methods.method import as_tensor
from gelflow.methods.name import MethodName
from gelflow.models.raft import RAFT
from gelflow.models.registration import registered
from gelflow.models.weights import read_metadata
from gelflow.training import train
from gelflow.training.test_time import fine_tuned, fine_tuning_settings

OWN = RegistrationConfig(windows_px=(8,), smoothing_px=(4,))
CHOICES: tuple[Registration, Registration] = ("none", "brightness")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = small(steps=1, batch_size=1, learning_rate=1e-4)
    return train(config, Shifts(1, 64, 1.0, seed=1), None, tmp_path_factory.mktemp("run")).weights


@pytest.fixture(scope="module")
def raft(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("raft") / "small.pth"
    torch.manual_seed(0)
    torch.save(RAFT(large=False).state_dict(), path)
    return path


def test_all_kinds_of_networks_share_one_table(weights: Path, raft: Path, tmp_path: Path, capsys) -> None:
    folder, out = write_folder(tmp_path / "data", {"a": (1, 0), "b": (0, 1)}), tmp_path / "out"
    common = ["compare", folder, "--weights", f"mine={weights}", "--device", "cpu", "--out", out]
    text = said(capsys, main, *common, "--methods", "none,lucas-kanade", "--weights", raft, "--ft", 2)
    names = ["no motion", "Lucas-Kanade", "mine", "RAFT small", "mine+ft"]
    assert all(name in text for name in names)
    rows = table(out / "scores.csv")
    assert list(dict.fromkeys(row["method"] for row in rows)) == names
    assert "strata" not in rows[0]
    apart = (out / "table.md").read_text().split("Fine-tuned on these very pairs")
    assert ["| mine+ft |" in part for part in apart[:2]] == [False, True]
    networks = json.loads((out / "scores.json").read_text())["networks"]
    assert set(networks) == {"mine", "RAFT small", "mine+ft"}
    assert all(one["pairs_per_second"] > 0 and one["size"] == [64, 80] for one in networks.values())
    assert (out / "work_precision.png").stat().st_size > 5000
    # The fine-tuned copy lies beside the results: the same command uses it again, another number of steps goes on.
    tuned = tmp_path / "out_ft" / "mine" / "weights.safetensors"
    assert read_metadata(tuned)["step"] == "2"
    before = load_file(tuned)
    said(capsys, main, *common, "--methods", "", "--batch", 0, "--ft", 2)
    torch.testing.assert_close(load_file(tuned), before, rtol=0, atol=0)
    said(capsys, main, *common, "--methods", "", "--batch", 0, "--ft", 3)
    assert read_metadata(tuned)["step"] == "3"


def test_fine_tuning_needs_a_place_and_a_network(weights: Path, tmp_path: Path, capsys) -> None:
    command = ["compare", write_folder(tmp_path / "data", {"a": (1, 0)}), "--ft", "5"]
    for given in (["--weights", weights], ["--out", tmp_path / "out"]):
        assert "--ft 5: needs --weights of GelFlow, and --out" in fails(capsys, *command, *given)


def test_fine_tuning_changes_the_copy_only_and_lowers_its_loss(weights: Path, tmp_path: Path, capsys) -> None:
    folder, before = write_folder(tmp_path / "data", {"a": (1, 0)}), weights.read_bytes()
    arguments = ["compare", folder, "--methods", "", "--weights", f"mine={weights}", "--batch", 0, "--json"]
    answer = json.loads(said(capsys, main, *arguments, "--ft", 40, "--out", tmp_path / "out"))
    assert weights.read_bytes() == before
    scores = {one["method"]: one for one in answer["methods"]}
    assert scores["mine+ft"]["psnr_db"] > scores["mine"]["psnr_db"]


@dataclass
class Counting:
    name: str = "counting"
    calls: int = 0

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        self.calls += 1
        return 0 * image1[..., :2]


def test_speed_leaves_out_the_first_call_and_the_front_what_none_beats(tmp_path: Path) -> None:
    method = Counting()
    scores = evaluate(method, PairDataset(write_folder(tmp_path, {"a": (1, 0), "b": (0, 1)})))
    assert (len(scores), method.calls) == (2, 1 + 2 * 2)  # there and back for closure
    points = [(3.0, 1.0), (1.0, 5.0), (2.0, 6.0), (2.0, 2.0), (4.0, 1.0), (1.0, 7.0)]
    assert pareto_front(points) == [1, 3, 0]
    assert pareto_front([]) == []
    assert network_speed(torch.add, (64, 64), 2, "cpu").pairs_per_second > 0


SMALL = ModelConfig(levels=4, projected_channels=8)
UNSUITABLE: dict[str, Any] = {
    "loss": {"lambda_s": [1.0, 1.0, 0.5], "alpha": 0.5},
    "supervision": "mixed", "mixed_self": 3.0, "motion": MotionConfig(), "color_jitter": 0.2, "crop_size": (64, 64),
    "compression": 0.1, "specks": 0.5,
    "ema_decay": 0.999, "schedule": "one_cycle", "warmup_steps": 100, "learning_rate": 4e-4, "batch_size": 16,
    "gradient_clip": 1.0, "flip": False, "seed": 5, "devices": 2, "workers": 3, "device": "cuda",
}  # fmt: skip
"""A training that nothing of may carry over but losses, clipping, flips, weight decay and seed."""


def unsuitable(path: Path, size: tuple[int, int] | None = None, **changes: object) -> Path:
    return random_weights(path, SMALL, TrainConfig.model_validate({"model": SMALL} | UNSUITABLE | changes), size)


@pytest.mark.parametrize("preset", ["best", "real", "bare", "paper", "selfflow"])
def test_whatever_the_preset_the_pairs_are_seen_as_they_are_and_without_truth(preset: str, tmp_path: Path) -> None:
    recorded = train_config(preset)
    model = ModelConfig(levels=recorded.model.levels, projected_channels=8, estimator="shared",
                        registration=RegistrationConfig())  # fmt: skip
    rate = min(recorded.learning_rate, 1e-4) if recorded.schedule == "one_cycle" else recorded.learning_rate
    method = Learned(random_weights(tmp_path / "w.safetensors", model, recorded, recorded.image_size), device="cpu")
    found = fine_tuning_settings(method, 1600, pairs=8)
    assert (found.supervision, found.motion, found.crop_size) == ("self", None, None)
    assert found.color_jitter == found.compression == found.specks == 0
    assert (found.schedule, found.warmup_steps, found.learning_rate, found.ema_decay) == ("constant", 0, rate, 0)
    assert (found.image_size, found.loss, found.model) == (recorded.image_size, recorded.loss, model)
    assert found.batch_size == 4  # the paper's, so that 1600 steps are 800 epochs


def test_of_the_training_a_constant_rate_and_the_size_of_use_carry_over(tmp_path: Path) -> None:
    method = Learned(unsuitable(tmp_path / "w.safetensors"), device="cpu")
    assert fine_tuning_settings(method, 12, pairs=3) == TrainConfig(
        model=SMALL, loss=UNSUITABLE["loss"], supervision="self", mixed_self=3.0, batch_size=3, steps=12,
        learning_rate=1e-4, gradient_clip=1.0, flip=False, seed=5, device="cpu",
    )  # fmt: skip
    path = unsuitable(tmp_path / "w.safetensors", (96, 128), schedule="constant", warmup_steps=0)
    settings = fine_tuning_settings(Learned(path, size=(64, 80), device="cpu"), 12, pairs=3)
    assert (settings.learning_rate, settings.image_size) == (4e-4, (64, 80))
    assert fine_tuning_settings(Learned(path, device="cpu"), 12, pairs=3).image_size == (96, 128)


def test_fine_tuning_does_not_look_at_exact_flow_and_needs_one_size(tmp_path: Path) -> None:
    shifts = [(1.5, 0.5), (-1.0, 0.0)]
    plain = PairDataset(write_folder(tmp_path / "plain", {"a": shifts[0], "b": shifts[1]}))
    exact = PairDataset(write_synthetic(tmp_path / "exact", shifts))
    method = Learned(unsuitable(tmp_path / "w.safetensors"), MethodName("net"), device="cpu")
    runs = [fine_tuned(method, dataset, tmp_path / f"run{k}", 3) for k, dataset in enumerate((plain, exact))]
    assert [str(run.name) for run in runs] == ["net+ft"] * 2
    assert same_weights(runs[0].path, runs[1].path)
    assert not same_weights(runs[0].path, method.path)
    recorded = json.loads(read_metadata(runs[0].path)["train"])
    assert (recorded["supervision"], recorded["steps"]) == ("self", 3)
    folders = [write_folder(tmp_path / f"{k}", {"a": (1, 0)}, size) for k, size in enumerate([(64, 80), (72, 80)])]
    path, given = method.path, (open_all(folders), tmp_path / "sizes", 1)
    words = "64x80, 72x80 px, a batch needs one size; give --size"
    refused(words, fine_tuned, Learned(path, device="cpu"), *given)
    assert fine_tuned(Learned(path, size=(64, 80), device="cpu"), *given).path.is_file()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("plain") / "w.safetensors", SMALL, small(model=SMALL))


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    model = SMALL.model_copy(update={"registration": OWN})
    return random_weights(tmp_path_factory.mktemp("own") / "w.safetensors", model, small(model=model))


def test_settings_are_the_weights_own_or_those_of_an_aim_which_the_name_says(plain: Path, own: Path) -> None:
    motion, brightness = REGISTRATIONS["motion"], REGISTRATIONS["brightness"]
    expected: list[tuple[Path, Registration | None, RegistrationConfig | None, str]] = [
        (plain, None, None, ""), (plain, "none", None, ""), (plain, "motion", motion, "+motion"),
        (own, None, OWN, "+registration"), (own, "none", None, ""), (own, "brightness", brightness, "+brightness"),
    ]  # fmt: skip
    for path, choice, config, added in expected:
        method = Learned(path, MethodName("net"), device="cpu", registration=choice)
        assert method.model.config.registration == config
        assert str(method.name) == f"net{added}"
    names = {"net": "net+motion", "net#2": "net+motion#2", "net#2+ft": "net+motion#2+ft", "net+ft": "net+motion+ft",
             "net+motion": "net+motion", "C# code": "C# code+motion"}  # fmt: skip
    given = [MethodName.parse(label) for label in names]
    assert [str(name) for name in given] == list(names)
    methods = [Learned(plain, name, device="cpu", registration="motion") for name in given]
    assert [str(method.name) for method in methods] == list(names.values())


def test_rows_without_and_with_registration_stand_in_one_table_with_one_of_raft(plain, raft, tmp_path) -> None:
    folder, out = write_folder(tmp_path / "data", {"a": (1.0, -0.5)}), tmp_path / "out"
    arguments = ["compare", str(folder), "--methods", "none", "--weights", f"net={plain}", "--weights", str(raft)]
    rows = [word for choice in CHOICES for word in ("--registration", choice)]
    assert main([*arguments, *rows, "--device", "cpu", "--ft", "2", "--batch", "0", "--out", str(out)]) == 0
    scores = {one["method"]: one for one in json.loads((out / "scores.json").read_text())["methods"]}
    assert list(scores) == ["no motion", "net", "net+brightness", "RAFT small", "net+ft", "net+brightness+ft"]
    assert scores["net+brightness"]["psnr_db"] > scores["net"]["psnr_db"] + 6
    assert scores["net+brightness+ft"]["psnr_db"] > scores["net+ft"]["psnr_db"] + 6
    # One optimisation for both rows, whose copy keeps what the weights had: no registration.
    assert [path.name for path in (tmp_path / "out_ft").iterdir()] == ["net"]
    model = json.loads(read_metadata(tmp_path / "out_ft" / "net" / "weights.safetensors")["model"])
    assert model["registration"] is None


def test_a_row_is_what_registration_makes_of_the_networks_flow_in_its_time(plain: Path, tmp_path, monkeypatch) -> None:
    images = PairDataset(write_folder(tmp_path, {"a": (1.0, -0.5)})).images(0)
    start, found = (Learned(plain, device="cpu", registration=choice).flow(*images) for choice in CHOICES)
    tensors = [as_tensor(array, "cpu") for array in (start, *images)]
    again = registered(*tensors, REGISTRATIONS["brightness"])[0].numpy()
    np.testing.assert_array_equal(np.moveaxis(found, -1, 0), again)

    def slow(*arguments: object) -> torch.Tensor:
        time.sleep(0.3)
        return registered(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(gelflow.models.gelflow, "registered", slow)
    (score,) = evaluate(Learned(plain, device="cpu", registration="motion"), PairDataset(tmp_path))
    assert score.seconds >= 0.3


def test_the_speed_of_the_network_alone_includes_it(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = PairDataset(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    measured = []

    def kept(passes: Callable[..., torch.Tensor], *_: object) -> Speed:
        with torch.no_grad():
            measured.append(passes(*(as_tensor(image, "cpu") for image in dataset.images(0)))[0].numpy())
        return Speed(1.0, None, 1, (64, 80), "here")

    monkeypatch.setattr(gelflow.compare.run, "network_speed", kept)
    method = Learned(own, MethodName("net"), device="cpu")
    compare([method], dataset)
    np.testing.assert_array_equal(np.moveaxis(measured[0], 0, -1), method.flow(*dataset.images(0)))


def test_predict_and_evaluate_take_it(plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1.0, -0.5)})
    common = ["--weights", plain, "--device", "cpu", "--registration"]
    flows = []
    for choice in CHOICES:
        out = tmp_path / choice
        text = said(capsys, main, "predict", folder / "a_1.png", folder / "a_2.png", "--out", out, *common, choice)
        flows.append(read_flow(out / "a.exr").flow)
        assert ("+brightness: mean motion" in text) == (choice == "brightness")
    # 1/8 px: the images are rounded to 8 bit, as in test_predict.
    assert np.abs(np.median(flows[1], axis=(0, 1)) - (1.0, -0.5)).max() < 1 / 8
    assert np.abs(np.median(flows[0], axis=(0, 1)) - (1.0, -0.5)).max() > 1 / 2
    answer = json.loads(said(capsys, main, "evaluate", folder, *common, "motion", "--json"))
    assert answer["methods"][0]["method"].endswith("+motion")


def test_registration_is_refused_where_there_is_none(plain: Path, raft: Path, tmp_path: Path, capsys) -> None:
    folder, out = write_folder(tmp_path / "data", {"a": (1, 0)}), tmp_path / "out"
    tail = ("--device", "cpu", "--registration", "motion")
    assert "is RAFT" in fails(capsys, "evaluate", folder, "--weights", raft, *tail)
    assert "needs --weights of GelFlow" in fails(capsys, "compare", folder, "--weights", raft, *tail)
    assert "dis-brightness" in fails(capsys, "compare", folder, "--methods", "none", *tail)
    assert "dis-brightness" in fails(capsys, "predict", folder, "--out", out, "--method", "dis-medium", *tail)
    assert "registration" in fails(capsys, "evaluate", folder, "--weights", plain, "--registration", "shading")
    assert not out.exists()
