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


def tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.moveaxis(array, -1, 0).copy())[None]


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Weights without and with a registration of their own."""
    models = [ModelConfig(levels=4, projected_channels=8, registration=config) for config in (None, OWN)]
    folder = tmp_path_factory.mktemp("networks")
    return [random_weights(folder / f"{k}.safetensors", model, small(model=model)) for k, model in enumerate(models)]


@pytest.fixture
def plain(networks: list[Path]) -> Path:
    return networks[0]


@pytest.fixture
def own(networks: list[Path]) -> Path:
    return networks[1]


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


def test_the_name_says_so_and_stays_one_of_a_group_of_seeds(plain: Path) -> None:
    names = {"net": "net+motion", "net#2": "net+motion#2", "net#2+ft": "net+motion#2+ft", "net+ft": "net+motion+ft",
             "net+motion": "net+motion", "C# code": "C# code+motion"}  # fmt: skip
    found = {label: Learned(plain, label, device="cpu", registration="motion").name for label in names}
    assert found == names


def test_rows_without_and_with_stand_in_one_table(plain: Path, tmp_path: Path) -> None:
    folder, out = write_folder(tmp_path / "data", {"a": (1.0, -0.5)}), tmp_path / "out"
    arguments = ["compare", str(folder), "--methods", "none", "--weights", f"net={plain}", "--device", "cpu"]
    assert main([*arguments, *ROWS, "--ft", "2", "--batch", "0", "--out", str(out)]) == 0
    scores = {one["method"]: one for one in json.loads((out / "scores.json").read_text())["methods"]}
    assert list(scores) == ["no motion", "net", "net+brightness", "net+ft", "net+brightness+ft"]
    assert scores["net+brightness"]["psnr_db"] > scores["net"]["psnr_db"] + 6
    assert scores["net+brightness+ft"]["psnr_db"] > scores["net+ft"]["psnr_db"] + 6
    # One optimisation for both rows, whose copy keeps what the weights had: no registration.
    assert [path.name for path in (tmp_path / "out_ft").iterdir()] == ["net"]
    model = json.loads(read_metadata(tmp_path / "out_ft" / "net" / "weights.safetensors")["model"])
    assert model["registration"] is None


def test_a_row_is_what_registration_makes_of_the_networks_flow(plain: Path, tmp_path: Path) -> None:
    images = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)})).images(0)
    start, found = (Learned(plain, device="cpu", registration=choice).flow(*images) for choice in CHOICES)
    again = registered(*map(tensor, (start, *images)), REGISTRATIONS["brightness"])[0].numpy()
    np.testing.assert_array_equal(np.moveaxis(found, -1, 0), again)


def test_the_speed_of_the_network_alone_includes_it(own: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    measured = []

    def kept(passes: Callable[..., torch.Tensor], *_: object) -> Speed:
        with torch.no_grad():
            measured.append(passes(*map(tensor, dataset.images(0)))[0].numpy())
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


def test_raft_keeps_its_one_row_beside_them_and_registration_is_refused_where_there_is_none(
    plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, raft, out = write_folder(tmp_path / "data", {"a": (1, 0)}), tmp_path / "small.pth", tmp_path / "out"
    torch.save(RAFT(large=False).state_dict(), raft)
    tail = ("--device", "cpu", "--registration", "motion")
    assert "is RAFT" in fails(capsys, "evaluate", folder, "--weights", raft, *tail)
    assert "needs --weights of GelFlow" in fails(capsys, "compare", folder, "--weights", raft, *tail)
    assert "dis-brightness" in fails(capsys, "compare", folder, "--methods", "none", *tail)
    assert "dis-brightness" in fails(capsys, "predict", folder, "--out", out, "--method", "dis-medium", *tail)
    assert "registration" in fails(capsys, "evaluate", folder, "--weights", plain, "--registration", "shading")
    assert not out.exists()
    weights = ["--weights", f"net={plain}", "--weights", str(raft), *ROWS]
    command = ["compare", str(folder), "--methods", "", "--out", str(out), "--batch", "0", "--device", "cpu"]
    assert main([*command, *weights]) == 0
    names = [one["method"] for one in json.loads((out / "scores.json").read_text())["methods"]]
    assert names == ["net", "net+brightness", "RAFT small"]


def test_a_comparison_can_be_added_to_by_name(plain: Path, tmp_path: Path) -> None:
    dataset = open_pairs(write_folder(tmp_path / "data", {"a": (1, 0)}))
    compare([Learned(plain, "net", device="cpu")], dataset, tmp_path / "out", batch=0)
    both = compare([Learned(plain, "net", None, "cpu", "brightness")], dataset, tmp_path / "out", batch=0, add=True)
    assert both.methods == ["net", "net+brightness"]
