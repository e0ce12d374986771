"""Weights on disk: a round trip, and one clear message for every file that is something else."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from gelflow.config import ModelConfig
from gelflow.errors import InputError
from gelflow.models import GelFlow
from gelflow.models.weights import load_weights, read_metadata, save_weights

SMALL = ModelConfig(levels=4, estimator="shared")


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "new" / "weights.safetensors"
    torch.manual_seed(1)
    network = GelFlow(SMALL)
    network.image_size = (96, 128)
    save_weights(path, network, note="of a test")
    return path


def rewritten(saved: Path, path: Path, **metadata: str) -> Path:
    """A copy of the weights with other metadata."""
    save_file(load_file(saved), path, read_metadata(saved) | metadata)
    return path


def test_weights_and_architecture_come_back(saved: Path) -> None:
    torch.manual_seed(1)
    network, loaded = GelFlow(SMALL), load_weights(saved)
    assert loaded.config == SMALL
    assert loaded.image_size == (96, 128)
    assert not loaded.training
    assert read_metadata(saved)["note"] == "of a test"
    images = torch.rand(2, 1, 3, 64, 64).unbind()
    with torch.no_grad():
        assert torch.equal(network(*images)[0], loaded(*images)[0])


def test_files_that_are_no_weights(saved: Path, tmp_path: Path) -> None:
    """Damaged ones and code that they would run: test_robustness."""
    with pytest.raises(InputError, match="there is no such file"):
        load_weights(tmp_path / "none.safetensors")
    for share in (0.0, 0.001, 0.5):
        (tmp_path / "cut.safetensors").write_bytes(saved.read_bytes()[: int(share * saved.stat().st_size)])
        with pytest.raises(InputError, match=r"cut\.safetensors: not a whole safetensors file"):
            load_weights(tmp_path / "cut.safetensors")
    torch.save({"model": GelFlow(SMALL).state_dict()}, tmp_path / "model.ckpt")
    with pytest.raises(InputError, match=r"pickled files .* are not opened"):
        load_weights(tmp_path / "model.ckpt")
    save_file({"weight": torch.zeros(3)}, tmp_path / "other.safetensors")
    with pytest.raises(InputError, match="not weights of GelFlow"):
        load_weights(tmp_path / "other.safetensors")


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("{", "do not describe a network"),
        ("[1]", "do not describe a network"),
        (json.dumps({"levels": 99}), "architecture in its metadata: levels"),
        (json.dumps({"shape": "round"}), "shape: there is no such setting"),
        (ModelConfig(levels=4).model_dump_json(), "do not fit its architecture: estimators.1.*is missing"),
        (ModelConfig(levels=4, estimator="shared", projected_channels=16).model_dump_json(), "has shape"),
    ],
)
def test_metadata_that_do_not_fit(saved: Path, tmp_path: Path, model: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        load_weights(rewritten(saved, tmp_path / "wrong.safetensors", model=model))


@pytest.mark.parametrize("size", ["5", "[]", '"x"', "[64]", "[64, 80.5]", "[true, 64]"])
def test_a_size_that_is_none(saved: Path, tmp_path: Path, size: str) -> None:
    with pytest.raises(InputError, match="image_size in its metadata must be null or"):
        load_weights(rewritten(saved, tmp_path / "wrong.safetensors", image_size=size))


def test_a_failed_write_keeps_the_former_file(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "weights.safetensors"
    path.write_bytes(saved.read_bytes())

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        save_weights(path, GelFlow(SMALL))
    assert path.read_bytes() == saved.read_bytes()
    assert list(tmp_path.iterdir()) == [path]
