"""What goes wrong at a user's desk, through the command line: one line that names the file or value, and status 2."""

import json
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from test_cli import fails
from textures import as_bytes, moved, save, write_folder
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
    random_weights(folder / "gelflow.safetensors", ModelConfig(levels=4, projected_channels=8))
    torch.save(RAFT(large=False, iterations=1).state_dict(), folder / "raft.pth")
    return folder / "gelflow.safetensors", folder / "raft.pth"


def damaged(kind: str, good: Path, path: Path, trace: Path) -> None:
    """Writes a broken copy of a file of weights."""
    if kind == "truncated":
        path.write_bytes(good.read_bytes()[: good.stat().st_size // 2])
    elif kind == "empty":
        path.touch()
    elif kind == "text":
        path.write_text("these are not weights\n")
    elif kind == "code":
        path.write_bytes(pickle.dumps(Evil(trace)))
    elif kind == "code in a torch file":
        torch.save({"model": Evil(trace)}, path)
    elif kind == "NaN" and good.suffix == ".pth":
        tensors = torch.load(good, weights_only=True)
        tensors["fnet.conv1.weight"][0, 0, 0, 0] = torch.nan
        torch.save(tensors, path)
    elif kind == "NaN":
        tensors = load_file(good)
        tensors["encoder.scales.0.0.0.weight"][0, 0, 0, 0] = torch.nan
        save_file(tensors, path, read_metadata(good))
    else:
        raise ValueError(kind)


@pytest.mark.parametrize("number", [0, 1], ids=["gelflow", "raft"])
@pytest.mark.parametrize("kind", ["truncated", "empty", "text", "code", "code in a torch file", "NaN"])
def test_damaged_weights_are_named_and_never_run(
    kind: str, number: int, networks: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, trace = networks[number], tmp_path / "ran"
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    bad = tmp_path / f"bad{good.suffix}"
    damaged(kind, good, bad, trace)
    images = [folder / "a_1.png", folder / "a_2.png"]
    commands: list[list[object]] = [
        ["evaluate", folder, "--weights", bad],
        ["compare", folder, "--methods", "", "--weights", f"x={bad}"],
        ["predict", *images, "--weights", bad, "--out", tmp_path / "out"],
    ]
    if number == 0:
        commands += [["finetune", folder, "--weights", bad, "--out", tmp_path / "run"],
                     ["export", bad, "--out", tmp_path / "x.onnx", "--size", "64x64"]]  # fmt: skip
    for command in commands:
        message = fails(capsys, *command)
        assert bad.name in message or command[0] == "export"
        assert kind != "NaN" or command[0] == "export" or "not finite" in message
    assert not trace.exists()
    assert not (tmp_path / "run").exists()


def test_a_state_to_resume_from_cannot_run_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_folder(tmp_path / "data", {"a": (1, 0)})
    run, trace = tmp_path / "run", tmp_path / "ran"
    (tmp_path / "small.toml").write_text("model.levels = 4\nloss.lambda_s = [1.0, 1.0, 1.0]\n", encoding="utf-8")
    small = ["--config", tmp_path / "small.toml", "--device", "cpu"]
    command = ["train", folder, "--out", run, "--steps", "1", *small]
    assert main([str(word) for word in command]) == 0
    capsys.readouterr()
    torch.save({"step": 0, "model": Evil(trace)}, run / "state.ckpt")
    assert "state.ckpt: damaged" in fails(capsys, *command, "--resume")
    assert not trace.exists()


@pytest.mark.parametrize("number", [0, 1], ids=["gelflow", "raft"])
def test_images_that_cannot_be_used_are_named(
    number: int, networks: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    weights = networks[number]
    tail = ["--weights", weights, "--out", tmp_path / "out", "--device", "cpu"]
    save(tmp_path / "one.png", moved(1, 1, 0, 0))
    save(tmp_path / "small.png", moved(40, 80, 0, 0))
    save(tmp_path / "good.png", moved(64, 80, 0, 0))
    save(tmp_path / "wide.png", moved(64, 96, 0, 0))
    broken = moved(64, 80, 0, 0)
    broken[3, 4, 1] = np.nan
    assert cv2.imwrite(str(tmp_path / "nan.tiff"), broken)

    def predict(first: str, second: str) -> str:
        return fails(capsys, "predict", tmp_path / first, tmp_path / second, *tail)

    assert "one.png: 1 x 1 px" in predict("one.png", "good.png")
    refusal = predict("small.png", "small.png")
    assert "small.png" in refusal
    assert "64 px" in refusal
    assert "good.png has 80 x 64 px, " in predict("good.png", "wide.png")
    assert "nan.tiff" in predict("good.png", "nan.tiff")
    if number == 0:
        good = [tmp_path / "good.png"] * 2
        assert "--size" in fails(capsys, "predict", *good, *tail, "--size", "64")
        assert "32x64: each side must be at least 64 px" in fails(capsys, "predict", *good, *tail, "--size", "32x64")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("number", [0, 1], ids=["gelflow", "raft"])
def test_arrays_that_cannot_be_used_are_named(number: int, networks: tuple[Path, Path]) -> None:
    method = open_network(networks[number], device="cpu")
    good = moved(64, 80, 0, 0)
    broken = good.copy()
    broken[5, 6, 0] = np.inf
    for image1, image2, word in (
        (good, broken, "image 2 holds NaN or infinite"),
        (good[..., 0], good[..., 0], "a grey image repeated"),
        (good, good[:, :70], "must be equal"),
        (good[:1, :1], good[:1, :1], "1 x 1 px"),
    ):
        with pytest.raises(InputError, match=word):
            method.flow(image1, image2)


def test_a_grey_image_is_three_equal_channels(networks: tuple[Path, Path], tmp_path: Path,
                                              capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    """Grey PNGs are welcome everywhere: the answer is that of the same image stored in colour."""
    for shift, name in ((0.0, "1"), (1.0, "2")):
        grey = as_bytes(moved(64, 80, shift, 0))[..., 0]
        for folder, pixels in (("grey", grey), ("colour", np.repeat(grey[..., None], 3, axis=2))):
            (tmp_path / folder).mkdir(exist_ok=True)
            assert cv2.imwrite(str(tmp_path / folder / f"a_{name}.png"), pixels)
    answers = []
    for folder in ("grey", "colour"):
        command = ["compare", str(tmp_path / folder), "--methods", "farneback", "--weights", f"net={networks[0]}",
                   "--batch", "0", "--device", "cpu", "--json"]  # fmt: skip
        assert main(command) == 0
        scores = json.loads(capsys.readouterr().out)["scores"]
        answers.append([(score["method"], score["psnr_db"], score["ssim"]) for score in scores])
    assert answers[0] == answers[1]
