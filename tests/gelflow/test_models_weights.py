"""Weights on disk: a round trip, one message for every file that is something else, the shipped ones; ONNX export."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused
from safetensors.torch import load_file, save_file
from test_cli import fails
from waves import press_flow

from gelflow.cli import app, main
from gelflow.config import REGISTRATIONS, ModelConfig
from gelflow.files.exr import read_flow
from gelflow.files.image import write_png
from gelflow.models import GelFlow
from gelflow.models.onnx import _Finest
from gelflow.models.weights import load_weights, read_metadata, save_weights, weights_file
from gelflow.ops.correlation import _unfolded, local_correlation

SMALL = ModelConfig(levels=4, estimator="shared")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "new" / "weights.safetensors"
    torch.manual_seed(1)
    network = GelFlow(SMALL)
    network.image_size = (96, 128)
    save_weights(path, network, note="of a test")
    return path


def test_weights_and_architecture_come_back_and_both_forms_of_the_correlation_agree(saved: Path) -> None:
    torch.manual_seed(1)
    network, loaded = GelFlow(SMALL), load_weights(saved)
    assert loaded.config == SMALL
    assert loaded.image_size == (96, 128)
    assert not loaded.training
    assert read_metadata(saved)["note"] == "of a test"
    images = torch.rand(2, 1, 3, 64, 64).unbind()
    with torch.no_grad():
        assert torch.equal(network(*images)[0], loaded(*images)[0])
    first, second = torch.rand(2, 2, 5, 7, 9, dtype=torch.float64)  # The exported graph holds another form
    torch.testing.assert_close(local_correlation(first, second, 3), _unfolded(first, second, 3), rtol=0, atol=1e-14)


def test_files_that_are_no_weights_are_named_and_a_failed_write_keeps_the_former_one(
    saved, tmp_path, monkeypatch
) -> None:
    for share in (0.0, 0.001, 0.5):
        (tmp_path / f"cut{share}.safetensors").write_bytes(saved.read_bytes()[: int(share * saved.stat().st_size)])
    torch.save({"model": GelFlow(SMALL).state_dict()}, tmp_path / "model.ckpt")
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    for name, words in (
        ("none.safetensors", "there is no such file"), ("model.ckpt", r"pickled files .* are not opened"),
        ("other.safetensors", "not weights of GelFlow"),
        *((f"cut{share}.safetensors", "not a whole safetensors file") for share in (0.0, 0.001, 0.5)),
    ):  # fmt: skip
        refused(rf"{name}: .*{words}", load_weights, tmp_path / name)
    path = tmp_path / "new" / "weights.safetensors"
    path.parent.mkdir()
    path.write_bytes(saved.read_bytes())

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left.*weights\.safetensors"):
        save_weights(path, GelFlow(SMALL))
    assert path.read_bytes() == saved.read_bytes()
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(("key", "values", "words"), [
    ("model", ["{", "[1]"], "do not describe a network"),
    ("model", ['{"levels": 99}'], "architecture in its metadata: levels"),
    ("model", ['{"shape": "round"}'], "shape: there is no such setting"),
    ("model", [ModelConfig(levels=4).model_dump_json()], "do not fit its architecture: estimators.1.*is missing"),
    ("model", [SMALL.model_copy(update={"projected_channels": 16}).model_dump_json()], "has shape"),
    ("image_size", ["5", "[]", '"x"', "[64]", "[64, 80.5]", "[true, 64]"], "image_size in its metadata must be null"),
])  # fmt: skip
def test_metadata_that_do_not_fit(saved: Path, tmp_path: Path, key: str, values: list[str], words: str) -> None:
    for value in values:
        save_file(load_file(saved), tmp_path / "wrong.safetensors", read_metadata(saved) | {key: value})
        refused(words, load_weights, tmp_path / "wrong.safetensors")


def test_names_files_and_the_recipe_of_best(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shipped, own = weights_file(None), Path("best")
    assert shipped.stat().st_size < 15e6
    assert weights_file(own) == shipped
    own.mkdir()  # a folder of that name is not in the way
    assert weights_file(own) == shipped
    own.rmdir()
    own.touch()  # a file of one's own comes first
    assert weights_file(own) == own
    refused("worst: there is no such file", load_weights, weights_file(Path("worst")))
    metadata = read_metadata(shipped)
    assert json.loads(metadata["train"])["supervision"] == "registered"
    assert f" {metadata['step']} " in shipped.with_name("train.sh").read_text(encoding="utf-8")
    assert load_weights(shipped).config.registration == REGISTRATIONS["motion"]


def dotted(side: int, flow: torch.Tensor) -> torch.Tensor:
    """(3, side, side): grey gel with soft black dots 24 px apart, seen where the gel has moved by the flow."""
    y, x = torch.meshgrid(torch.arange(side) + 0.5, torch.arange(side) + 0.5, indexing="ij")
    x, y = x + flow[0], y + flow[1]
    distance = torch.hypot((x % 24) - 12, (y % 24) - 12)
    shade = torch.stack([0.6 + 0.0005 * x, 0.6 - 0.0004 * y, torch.full_like(x, 0.55)])
    return (shade * (1 - 0.8 * torch.sigmoid((5 - distance) / 0.7))).clamp(0, 1).float()


def test_the_shipped_network_follows_dots_that_it_has_never_seen_and_commands_take_it_by_default(
    tmp_path, capsys
) -> None:
    flow = press_flow(240, 240, 6.0)
    for name, motion in (("a", flow), ("b", torch.zeros_like(flow))):
        write_png(tmp_path / f"{name}.png", (255 * dotted(240, motion)).round().byte().permute(1, 2, 0).numpy())
    images = [str(tmp_path / f"{name}.png") for name in "ab"]
    assert app(["predict", *images, "--out", str(tmp_path), "--device", "cpu"]) == 0
    assert "best" in capsys.readouterr().out
    found = torch.from_numpy(read_flow(tmp_path / "a_to_b.exr").flow).permute(2, 0, 1)
    # Measured: 0.12 px of 2.18 px. Untrained weights: 2.13 px.
    assert (found - flow).norm(dim=0).mean() < 0.3 * flow.norm(dim=0).mean()


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    network = GelFlow(ModelConfig(levels=4, projected_channels=8, refine="half"))
    with torch.no_grad():  # a fresh network sees next to no motion: let the heads answer a hundred times as strongly
        for name, value in network.named_parameters():
            if "head.weight" in name:
                value *= 100
    save_weights(tmp_path / "weights.safetensors", network)
    return tmp_path / "weights.safetensors"


def test_what_is_exported_is_the_finest_flow(weights: Path) -> None:
    images = torch.rand(2, 1, 3, 67, 74).unbind()
    assert _Finest(load_weights(weights))(*images).shape == (1, 2, 67, 74)


@pytest.mark.slow
def test_the_exported_network_gives_the_same_flow(weights: Path, tmp_path: Path) -> None:
    runtime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    pytest.importorskip("onnxscript", reason="onnxscript is not installed")
    out = tmp_path / "new" / "flow.onnx"
    for _ in range(2):  # the second time in place of the first file
        assert main(["export", str(weights), "--out", str(out), "--size", "67x74"]) == 0
    images = torch.rand(2, 1, 3, 67, 74).unbind()
    session = runtime.InferenceSession(str(out))
    (flow,) = session.run(["flow"], {f"image{k + 1}": image.numpy() for k, image in enumerate(images)})
    with torch.no_grad():
        expected = load_weights(weights)(*images)[0].numpy()
    assert np.abs(expected).max() > 0.1
    # float32 sums in another order: 1e-6 of the largest flow per convolution, some 30 of them.
    np.testing.assert_allclose(flow, expected, atol=3e-5 * np.abs(expected).max())


@pytest.mark.parametrize(("tail", "word"), [
    (["--out", "x.onnx"], "was trained on images of any size"),
    (["--out", "x.pt", "--size", "64x64"], "ending in .onnx"),
    (["--out", "x.onnx", "--size", "32x64"], "at least 64 px"),
    (["--out", "x.onnx", "--size", "big"], "ROWSxCOLUMNS"),
    (["--out", "other.onnx", "--size", "64x64"], "other.onnx: exists and does not come from this command"),
    (["--out", "x.onnx", "--size", "64x64"], "pip install onnx onnxscript"),
])  # fmt: skip
def test_mistakes_are_one_line(weights: Path, tail: list[str], word: str, capsys, monkeypatch) -> None:
    monkeypatch.setattr("gelflow.models.onnx.find_spec", lambda name: None if "pip" in word else name)
    monkeypatch.chdir(weights.parent)
    Path("other.onnx").write_text("another's")
    assert word in fails(capsys, "export", weights.name, *tail)
    assert sorted(path.name for path in weights.parent.iterdir()) == ["other.onnx", weights.name]
    assert Path("other.onnx").read_text() == "another's"
