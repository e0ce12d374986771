"""Elastic refinement where a network is used: rows with and without, names, time, after fine-tuning, refusals."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from test_cli import fails
from textures import write_folder

import gelflow.compare
import gelflow.estimate
from gelflow.baselines.elastic import preset_elastic
from gelflow.baselines.learned import Elastic, Learned
from gelflow.cli import main
from gelflow.compare import compare
from gelflow.config import ElasticConfig, ModelConfig, TrainConfig
from gelflow.data import open_pairs
from gelflow.evaluate import evaluate
from gelflow.files.exr import read_flow
from gelflow.models import GelFlow
from gelflow.models.elastic import refined
from gelflow.models.raft import RAFT
from gelflow.speed import Speed
from gelflow.train.checkpoint import read_metadata, save_weights

OWN = ElasticConfig(spacings=(16,), iterations=2)


def network(path: Path, elastic: ElasticConfig | None) -> Path:
    """Random weights of a small network, as a training leaves them."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    model = ModelConfig(levels=4, projected_channels=8, elastic=elastic)
    config = TrainConfig.model_validate({"model": model, "loss": {"lambda_s": [1.0, 1.0, 1.0]}})
    save_weights(path, GelFlow(model), train=config.model_dump_json(), step="0")
    return path


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return network(tmp_path_factory.mktemp("plain") / "weights.safetensors", None)


@pytest.fixture(scope="module")
def elastic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return network(tmp_path_factory.mktemp("elastic") / "weights.safetensors", OWN)


def test_the_settings_are_the_weights_own_or_those_of_the_preset(plain: Path, elastic: Path) -> None:
    """Fails with the preset's settings wherever it is switched on, and with "off" read as "as the weights say"."""
    expected: dict[tuple[Path, Elastic], ElasticConfig | None] = {
        (plain, None): None, (plain, "off"): None, (plain, "on"): preset_elastic(),
        (elastic, None): OWN, (elastic, "off"): None, (elastic, "on"): OWN,
    }  # fmt: skip
    for (path, choice), config in expected.items():
        method = Learned(path, "net", device="cpu", elastic=choice)
        assert method.model.config.elastic == config
        assert method.name == ("net" if config is None else "net+elastic")


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("net", "net+elastic"),
        ("net#2", "net+elastic#2"),
        ("net#2+ft", "net+elastic#2+ft"),
        ("net+ft", "net+elastic+ft"),
        ("net+elastic", "net+elastic"),
        ("C# code", "C# code+elastic"),
    ],
)
def test_the_name_says_so_and_stays_one_of_a_group_of_seeds(elastic: Path, label: str, name: str) -> None:
    """Fails with the suffix at the very end: seeds are no group then, and "+ft" is not seen."""
    assert Learned(elastic, label, device="cpu").name == name


def test_rows_without_and_with_stand_in_one_table(plain: Path, tmp_path: Path) -> None:
    """Fails with the elastic refinement not handed on to `estimate_flow`."""
    folder, out = write_folder(tmp_path / "data", {"a": (1.0, -0.5)}), tmp_path / "out"
    arguments = ["compare", str(folder), "--methods", "none", "--weights", f"net={plain}", "--device", "cpu"]
    assert main([*arguments, "--elastic", "both", "--ft", "2", "--batch", "0", "--out", str(out)]) == 0
    scores = {one["method"]: one for one in json.loads((out / "scores.json").read_text())["methods"]}
    assert list(scores) == ["no motion", "net", "net+elastic", "net+ft", "net+elastic+ft"]
    # The untrained network says next to nothing; the refinement finds the shift of 1.1 px by itself.
    assert scores["net+elastic"]["psnr_db"] > scores["net"]["psnr_db"] + 6
    assert scores["net+elastic+ft"]["psnr_db"] > scores["net+ft"]["psnr_db"] + 6
    # One optimisation for both rows, whose copy keeps what the weights had: no refinement.
    assert [path.name for path in (tmp_path / "out_ft").iterdir()] == ["net"]
    model = json.loads(read_metadata(tmp_path / "out_ft" / "net" / "weights.safetensors")["model"])
    assert model["elastic"] is None


def test_a_row_is_what_the_refinement_makes_of_the_networks_flow(plain: Path, tmp_path: Path) -> None:
    dataset = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    images = dataset.images(0)
    start, found = (Learned(plain, device="cpu", elastic=choice).flow(*images) for choice in ("off", "on"))
    tensors = [torch.from_numpy(np.moveaxis(array, -1, 0).copy())[None] for array in (start, *images)]
    again = refined(*tensors, preset_elastic())[0].numpy()
    np.testing.assert_array_equal(np.moveaxis(found, -1, 0), again)


def test_the_speed_of_the_network_alone_includes_it(
    elastic: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fails with the speed of the network's own forward pass, and with `Learned.forward` without the refinement."""
    dataset = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    images = [torch.from_numpy(np.moveaxis(image, -1, 0).copy())[None] for image in dataset.images(0)]
    measured = []

    def kept(passes: Callable[..., torch.Tensor], *_: object) -> Speed:
        with torch.no_grad():
            measured.append(passes(*images)[0].numpy())
        return Speed(1.0, None, 1, (64, 80), "here")

    monkeypatch.setattr(gelflow.compare, "network_speed", kept)
    method = Learned(elastic, "net", device="cpu")
    compare([method], dataset)
    np.testing.assert_array_equal(np.moveaxis(measured[0], 0, -1), method.flow(*dataset.images(0)))


def test_its_time_counts(plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails with the second reading of the clock before the method's call."""

    def slow(*arguments: object) -> torch.Tensor:
        time.sleep(0.3)
        return refined(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(gelflow.estimate, "refined", slow)
    dataset = open_pairs(write_folder(tmp_path, {"a": (1.0, -0.5)}))
    (score,) = evaluate(Learned(plain, device="cpu", elastic="on"), dataset)
    assert score.seconds >= 0.3


def test_predict_and_evaluate_take_it(plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Fails with the option not handed on by either command."""
    folder = write_folder(tmp_path / "data", {"a": (1.0, -0.5)})
    common = ["--weights", str(plain), "--device", "cpu", "--elastic"]
    flows = []
    for choice in ("off", "on"):
        out = tmp_path / choice
        assert main(["predict", *(str(folder / f"a_{k}.png") for k in (1, 2)), "--out", str(out), *common, choice]) == 0
        flows.append(read_flow(out / "a.exr").flow)
        assert ("+elastic: mean motion" in capsys.readouterr().out) == (choice == "on")
    # 1/8 px: the images are rounded to 8 bit, as in test_predict.
    assert np.abs(np.median(flows[1], axis=(0, 1)) - (1.0, -0.5)).max() < 1 / 8
    assert np.abs(np.median(flows[0], axis=(0, 1)) - (1.0, -0.5)).max() > 1 / 2
    assert main(["evaluate", str(folder), *common, "on", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["methods"][0]["method"].endswith("+elastic")


def test_what_has_none_is_refused(plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    raft = tmp_path / "small.pth"
    torch.save(RAFT(large=False).state_dict(), raft)
    tail = ("--device", "cpu", "--elastic", "on")
    assert "is RAFT" in fails(capsys, "evaluate", folder, "--weights", raft, *tail)
    assert "needs --weights of GelFlow" in fails(capsys, "compare", folder, "--weights", raft, *tail)
    assert "dis-elastic" in fails(capsys, "compare", folder, "--methods", "none", *tail)
    out = ("--out", tmp_path / "out")
    assert "dis-elastic" in fails(capsys, "predict", folder, *out, "--method", "dis-medium", *tail)
    assert "elastic" in fails(capsys, "evaluate", folder, "--weights", plain, "--elastic", "both")
    assert not (tmp_path / "out").exists()


def test_raft_keeps_its_one_row_beside_them(plain: Path, tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    torch.save(RAFT(large=False).state_dict(), tmp_path / "small.pth")
    weights = ["--weights", f"net={plain}", "--weights", str(tmp_path / "small.pth"), "--elastic", "both"]
    out = ["--out", str(tmp_path / "out"), "--batch", "0", "--device", "cpu"]
    assert main(["compare", str(folder), "--methods", "", *weights, *out]) == 0
    names = [one["method"] for one in json.loads((tmp_path / "out" / "scores.json").read_text())["methods"]]
    assert names == ["net", "net+elastic", "RAFT small"]


def test_a_comparison_can_be_added_to_by_name(plain: Path, tmp_path: Path) -> None:
    dataset = open_pairs(write_folder(tmp_path / "data", {"a": (1, 0)}))
    compare([Learned(plain, "net", device="cpu")], dataset, tmp_path / "out", batch=0)
    both = compare([Learned(plain, "net", None, "cpu", "on")], dataset, tmp_path / "out", batch=0, add=True)
    assert both.methods == ["net", "net+elastic"]
