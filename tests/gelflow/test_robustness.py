"""What goes wrong at a user's desk, through the command line: one line that names the file or value, and status 2."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from test_cli import fails
from textures import moved, save, write_folder
from waves import random_weights

from gelflow.baselines.learned import open_network
from gelflow.cli import main
from gelflow.config import ModelConfig
from gelflow.errors import InputError
from gelflow.models.raft import RAFT
from gelflow.models.weights import read_metadata


class Evil:
    """Pickled, it would make a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Weights of GelFlow and of RAFT, as they are at the start of a training."""
    folder = tmp_path_factory.mktemp("networks")
    torch.save(RAFT(large=False, iterations=1).state_dict(), folder / "raft.pth")
    model = ModelConfig(levels=4, projected_channels=8)
    return random_weights(folder / "gelflow.safetensors", model), folder / "raft.pth"


def damaged(kind: str, good: Path, path: Path, trace: Path) -> None:
    """Writes a broken copy of a file of weights."""
    contents = {"truncated": good.read_bytes()[: good.stat().st_size // 2], "empty": b"", "text": b"no weights\n",
                "code": pickle.dumps(Evil(trace))}  # fmt: skip
    if kind in contents:
        path.write_bytes(contents[kind])
    elif kind == "code in a torch file":
        torch.save({"model": Evil(trace)}, path)
    elif good.suffix == ".pth":
        tensors = torch.load(good, weights_only=True)
        tensors["fnet.conv1.weight"][0, 0, 0, 0] = torch.nan
        torch.save(tensors, path)
    else:
        tensors = load_file(good)
        tensors["encoder.scales.0.0.0.weight"][0, 0, 0, 0] = torch.nan
        save_file(tensors, path, read_metadata(good))


@pytest.mark.parametrize("number", [0, 1], ids=["gelflow", "raft"])
@pytest.mark.parametrize("kind", ["truncated", "empty", "text", "code", "code in a torch file", "NaN"])
def test_damaged_weights_are_named_and_never_run(kind, number, networks, tmp_path, capsys) -> None:
    good, trace, run = networks[number], tmp_path / "ran", tmp_path / "run"
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    bad = tmp_path / f"bad{good.suffix}"
    damaged(kind, good, bad, trace)
    images = [folder / "a_1.png", folder / "a_2.png"]
    for command in (
        ["evaluate", folder, "--weights", bad], ["compare", folder, "--methods", "", "--weights", f"x={bad}"],
        ["predict", *images, "--weights", bad, "--out", tmp_path / "out"],
        *([["finetune", folder, "--weights", bad, "--out", run]] if number == 0 else []),
    ):  # fmt: skip
        message = fails(capsys, *command)
        assert bad.name in message
        assert kind != "NaN" or "not finite" in message
    if number == 0:
        fails(capsys, "export", bad, "--out", tmp_path / "x.onnx", "--size", "64x64")
    assert not trace.exists()
    assert not run.exists()


def test_a_state_to_resume_from_cannot_run_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    run, trace, settings = tmp_path / "run", tmp_path / "ran", tmp_path / "small.toml"
    settings.write_text("steps = 1\nmodel.levels = 4\nloss.lambda_s = [1.0, 1.0, 1.0]\n")
    command = ["train", str(folder), "--out", str(run), "--config", str(settings), "--device", "cpu"]
    assert main(command) == 0
    capsys.readouterr()
    torch.save({"step": 0, "model": Evil(trace)}, run / "state.ckpt")
    assert "state.ckpt: damaged" in fails(capsys, *command, "--resume")
    assert not trace.exists()


@pytest.mark.parametrize("number", [0, 1], ids=["gelflow", "raft"])
def test_images_that_cannot_be_used_are_named(number: int, networks: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    tail = ["--weights", networks[number], "--out", tmp_path / "out", "--device", "cpu"]
    for name, size in (("one", (1, 1)), ("small", (40, 80)), ("good", (64, 80)), ("wide", (64, 96))):
        save(tmp_path / f"{name}.png", moved(*size, 0, 0))
    good = moved(64, 80, 0, 0)
    broken = good.copy()
    broken[3, 4, 1] = np.nan
    assert cv2.imwrite(str(tmp_path / "nan.tiff"), broken)

    def predict(first: str, second: str, *options: str) -> str:
        return fails(capsys, "predict", tmp_path / first, tmp_path / second, *tail, *options)

    assert "one.png: 1 x 1 px" in predict("one.png", "good.png")
    refusal = predict("small.png", "small.png")
    assert "small.png" in refusal
    assert "64 px" in refusal
    assert "good.png has 80 x 64 px, " in predict("good.png", "wide.png")
    assert "nan.tiff" in predict("good.png", "nan.tiff")
    if number == 0:
        assert "--size" in predict("good.png", "good.png", "--size", "64")
        assert "32x64: each side must be at least 64 px" in predict("good.png", "good.png", "--size", "32x64")
    assert not (tmp_path / "out").exists()
    method = open_network(networks[number], device="cpu")
    for image1, image2, word in (
        (good, broken, "image 2 holds NaN or infinite"), (good[..., 0], good[..., 0], "a grey image repeated"),
        (good, good[:, :70], "must be equal"), (good[:1, :1], good[:1, :1], "1 x 1 px"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=word):
            method.flow(image1, image2)
