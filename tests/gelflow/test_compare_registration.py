"""Registration where a network is used: rows with and without, names, time, after fine-tuning, refusals."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from test_cli import fails
from textures import write_folder
from waves import random_weights, small

import gelflow.compare.run
import gelflow.models.gelflow
from gelflow.baselines.learned import Learned
from gelflow.cli import main
from gelflow.compare.run import compare
from gelflow.compare.scores import evaluate
from gelflow.compare.speed import Speed
from gelflow.config import REGISTRATIONS, ModelConfig, Registration, RegistrationConfig
from gelflow.data import open_pairs
from gelflow.files.exr import read_flow
from gelflow.models.raft import RAFT
from gelflow.models.registration import registered
from gelflow.models.weights import read_metadata

OWN = RegistrationConfig(windows_px=(8,), smoothing_px=(4,))


CHOICES: tuple[Registration, Registration] = ("none", "brightness")
ROWS = [word for choice in CHOICES for word in ("--registration", choice)]
BRIGHTNESS = REGISTRATIONS["brightness"]


def network(path: Path, registration: RegistrationConfig | None) -> Path:
    model = ModelConfig(levels=4, projected_channels=8, registration=registration)
    return random_weights(path, model, small(model=model))


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return network(tmp_path_factory.mktemp("plain") / "weights.safetensors", None)


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return network(tmp_path_factory.mktemp("own") / "weights.safetensors", OWN)


def test_the_settings_are_the_weights_own_or_those_of_an_aim(plain: Path, own: Path) -> None:
    motion, brightness = REGISTRATIONS["motion"], REGISTRATIONS["brightness"]
    expected: list[tuple[Path, Registration | None, RegistrationConfig | None, str]] = [
        (plain, None, None, ""), (plain, "none", None, ""), (plain, "motion", motion, "+motion"),
        (own, None, OWN, "+registration"), (own, "none", None, ""), (own, "brightness", brightness, "+brightness"),
    ]  # fmt: skip
    for path, choice, config, added in expected:
        method = Learned(path, "net", device="cpu", registration=choice)
        assert method.model.config.registration == config
        assert method.name == f"net{added}"


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("net", "net+motion"),
        ("net#2", "net+motion#2"),
        ("net#2+ft", "net+motion#2+ft"),
        ("net+ft", "net+motion+ft"),
        ("net+motion", "net+motion"),
        ("C# code", "C# code+motion"),
    ],
)
def test_the_name_says_so_and_stays_one_of_a_group_of_seeds(plain: Path, label: str, name: str) -> None:
    assert Learned(plain, label, device="cpu", registration="motion").name == name


def test_rows_without_and_with_stand_in_one_table(plain: Path, tmp_path: Path) -> None:
    folder, out = write_folder(tmp_path / "data", {"a": (1.0, -0.5)}), tmp_path / "out"
    arguments = ["compare", str(folder), "--methods", "none", "--weights", f"net={plain}", "--device", "cpu"]
    assert main([*arguments, *ROWS, "--ft", "2", "--batch", "0", "--out", str(out)]) == 0
    scores = {one["method"]: one for one in json.loads((out / "scores.json").read_text())["methods"]}
    assert list(scores) == ["no motion", "net", "net+brightness", "net+ft", "net+brightness+ft"]
    # The untrained network says next to nothing; registration finds the shift of 1.1 px by itself.
    assert scores["net+brightness"]["psnr_db"] > scores["net"]["psnr_db"] + 6
    assert scores["net+brightness+ft"]["psnr_db"] > scores["net+ft"]["psnr_db"] + 6
    # One optimisation for both rows, whose copy keeps what the weights had: no registration.
    assert [path.name for path in (tmp_path / "out_ft").iterdir()] == ["net"]
    model = json.loads(read_metadata(tmp_path / "out_ft" / "net" / "weights.safetensors")["model"])
    assert model["registration"] is None


def test_a_row_is_what_registration_makes_of_the_networks_flow(plain: Path, tmp_path: Path) -> None:
    dataset = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    images = dataset.images(0)
    start, found = (Learned(plain, device="cpu", registration=choice).flow(*images) for choice in CHOICES)
    tensors = [torch.from_numpy(np.moveaxis(array, -1, 0).copy())[None] for array in (start, *images)]
    again = registered(*tensors, BRIGHTNESS)[0].numpy()
    np.testing.assert_array_equal(np.moveaxis(found, -1, 0), again)


def test_the_speed_of_the_network_alone_includes_it(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    images = [torch.from_numpy(np.moveaxis(image, -1, 0).copy())[None] for image in dataset.images(0)]
    measured = []

    def kept(passes: Callable[..., torch.Tensor], *_: object) -> Speed:
        with torch.no_grad():
            measured.append(passes(*images)[0].numpy())
        return Speed(1.0, None, 1, (64, 80), "here")

    monkeypatch.setattr(gelflow.compare.run, "network_speed", kept)
    method = Learned(own, "net", device="cpu")
    compare([method], dataset)
    np.testing.assert_array_equal(np.moveaxis(measured[0], 0, -1), method.flow(*dataset.images(0)))


def test_its_time_counts(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:

    def slow(*arguments: object) -> torch.Tensor:
        time.sleep(0.3)
        return registered(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(gelflow.models.gelflow, "registered", slow)
    dataset = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    (score,) = evaluate(Learned(plain, device="cpu", registration="motion"), dataset)
    assert score.seconds >= 0.3


def test_predict_and_evaluate_take_it(plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1.0, -0.5)})
    common = ["--weights", str(plain), "--device", "cpu", "--registration"]
    flows = []
    for choice in CHOICES:
        out = tmp_path / choice
        assert main(["predict", *(str(folder / f"a_{k}.png") for k in (1, 2)), "--out", str(out), *common, choice]) == 0
        flows.append(read_flow(out / "a.exr").flow)
        assert ("+brightness: mean motion" in capsys.readouterr().out) == (choice == "brightness")
    # 1/8 px: the images are rounded to 8 bit, as in test_predict.
    assert np.abs(np.median(flows[1], axis=(0, 1)) - (1.0, -0.5)).max() < 1 / 8
    assert np.abs(np.median(flows[0], axis=(0, 1)) - (1.0, -0.5)).max() > 1 / 2
    assert main(["evaluate", str(folder), *common, "motion", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["methods"][0]["method"].endswith("+motion")


def test_what_has_none_is_refused(plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    raft = tmp_path / "small.pth"
    torch.save(RAFT(large=False).state_dict(), raft)
    tail = ("--device", "cpu", "--registration", "motion")
    assert "is RAFT" in fails(capsys, "evaluate", folder, "--weights", raft, *tail)
    assert "needs --weights of GelFlow" in fails(capsys, "compare", folder, "--weights", raft, *tail)
    assert "dis-brightness" in fails(capsys, "compare", folder, "--methods", "none", *tail)
    out = ("--out", tmp_path / "out")
    assert "dis-brightness" in fails(capsys, "predict", folder, *out, "--method", "dis-medium", *tail)
    assert "registration" in fails(capsys, "evaluate", folder, "--weights", plain, "--registration", "shading")
    assert not (tmp_path / "out").exists()


def test_raft_keeps_its_one_row_beside_them(plain: Path, tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    torch.save(RAFT(large=False).state_dict(), tmp_path / "small.pth")
    weights = ["--weights", f"net={plain}", "--weights", str(tmp_path / "small.pth"), *ROWS]
    out = ["--out", str(tmp_path / "out"), "--batch", "0", "--device", "cpu"]
    assert main(["compare", str(folder), "--methods", "", *weights, *out]) == 0
    names = [one["method"] for one in json.loads((tmp_path / "out" / "scores.json").read_text())["methods"]]
    assert names == ["net", "net+brightness", "RAFT small"]


def test_a_comparison_can_be_added_to_by_name(plain: Path, tmp_path: Path) -> None:
    dataset = open_pairs(write_folder(tmp_path / "data", {"a": (1, 0)}))
    compare([Learned(plain, "net", device="cpu")], dataset, tmp_path / "out", batch=0)
    both = compare([Learned(plain, "net", None, "cpu", "brightness")], dataset, tmp_path / "out", batch=0, add=True)
    assert both.methods == ["net", "net+brightness"]
