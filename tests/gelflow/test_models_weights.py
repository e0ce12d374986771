"""Weights on disk: a round trip, one message for every file that is something else, and the shipped ones."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from waves import press_flow

from gelflow.cli import app
from gelflow.config import REGISTRATIONS, ModelConfig
from gelflow.errors import InputError
from gelflow.files.image import write_png
from gelflow.models import GelFlow
from gelflow.models.estimate import estimate_flow
from gelflow.models.weights import load_weights, read_metadata, save_weights, weights_file

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


def test_names_and_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shipped = weights_file(None)
    assert weights_file(Path("best")) == shipped
    assert shipped.stat().st_size < 15e6
    (tmp_path / "best").mkdir()  # a folder of that name is not in the way
    assert weights_file(Path("best")) == shipped
    (tmp_path / "best").rmdir()
    (tmp_path / "best").touch()  # a file of one's own comes first
    assert weights_file(Path("best")) == Path("best")
    with pytest.raises(InputError, match="worst: there is no such file"):
        load_weights(weights_file(Path("worst")))


def test_the_card_describes_best() -> None:
    path = weights_file(None)
    card = path.with_name("README.md").read_text(encoding="utf-8")
    metadata = read_metadata(path)
    assert json.loads(metadata["train"])["supervision"] == "mixed"
    assert f"then {metadata['step']} steps" in card
    assert ModelConfig.model_validate_json(metadata["model"]).registration == REGISTRATIONS["motion"]


def dotted(side: int, flow: torch.Tensor) -> torch.Tensor:
    """(3, side, side): grey gel with soft black dots 24 px apart, seen where the gel has moved by the flow."""
    y, x = torch.meshgrid(torch.arange(side) + 0.5, torch.arange(side) + 0.5, indexing="ij")
    x, y = x + flow[0], y + flow[1]
    distance = torch.hypot((x % 24) - 12, (y % 24) - 12)
    shade = torch.stack([0.6 + 0.0005 * x, 0.6 - 0.0004 * y, torch.full_like(x, 0.55)])
    return (shade * (1 - 0.8 * torch.sigmoid((5 - distance) / 0.7))).clamp(0, 1).float()


def test_it_follows_dots_that_it_has_never_seen() -> None:
    flow = press_flow(240, 240, 6.0)
    image1, image2 = (dotted(240, motion)[None] for motion in (flow, torch.zeros_like(flow)))
    found = estimate_flow(load_weights(weights_file(None)), image1, image2)[0]
    error, moved = (found - flow).norm(dim=0), flow.norm(dim=0)
    # Measured: 0.12 px of 2.18 px. Untrained weights: 2.13 px.
    assert error.mean() < 0.3 * moved.mean()


def test_commands_take_them_by_default(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = torch.zeros(2, 96, 96)
    for name, motion in (("a", still + 1.0), ("b", still)):
        write_png(tmp_path / f"{name}.png", (255 * dotted(96, motion)).byte().permute(1, 2, 0).numpy())
    out = tmp_path / "out"
    assert app(["predict", str(tmp_path / "a.png"), str(tmp_path / "b.png"), "--out", str(out), "--device", "cpu"]) == 0
    assert "best" in capsys.readouterr().out
    assert list(out.glob("*.exr"))
