"""The command line: exit statuses, one line per mistake that names the file or value, nothing run from files."""

import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from commands import complaint, said
from safetensors.torch import load_file, save_file
from textures import as_bytes, moved, save, write_folder, write_synthetic, write_video
from waves import random_weights

from gelflow import terminal
from gelflow.cli import main
from gelflow.cli.options import METHODS
from gelflow.config import ModelConfig
from gelflow.models.raft import RAFT
from gelflow.models.weights import read_metadata


def fails(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of a command that must end with status 2."""
    words = complaint(capsys, main, *arguments)
    assert "\n" not in words
    return words


def video(path: Path) -> Path:
    write_video(path, [as_bytes(moved(64, 96, shift, 0)) for shift in (0, 3, 6, 9)])
    return path


def test_the_module_passes_the_status_on_and_debug_shows_the_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    done = subprocess.run([sys.executable, "-m", "gelflow", "compare", "/nothing/here"], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == "gelflow: /nothing/here: there is no such folder; a folder with image pairs is needed\n"
    assert "Traceback" in said(capsys, main, "--debug", "compare", "/nothing/here", status=2)


@pytest.mark.parametrize(("arguments", "word"), [
    (["fly"], "Unknown command"),
    (["compare"], "DATA"),
    (["compare", ".", "--wings"], "--wings"),
    (["pairs", ".", "--out", "o", "--seed", "many"], "seed"),
    (["predict", "a.png", "b.png", "--out", "o", "--method", "none"], "a.png"),
    (["predict", ".", ".", ".", "--out", "o", "--method", "none"], "3 inputs"),
    (["predict", ".", "--out", "o", "--weights", "w", "--method", "tvl1"], "--weights"),
    (["predict", ".", "--out", "o", "--size", "64x80", "--method", "tvl1"], "--size (of a network)"),
    (["predict", ".", "--out", "o"], "holds no image"),
    (["predict", ".", "--out", "o", "--method", "raft"], f"allowed: {METHODS}; in compare"),
    (["evaluate", ".", "--weights", "none.safetensors"], "none.safetensors"),
    (["compare", ".", "--weights", "best=none.safetensors"], "none.safetensors"),
    (["compare", ".", "--weights", "x", "--size", "big"], "--size big"),
    (["predict", ".", "--out", "o", "--size", "100000x100000"], "at most 16777216 px are allowed"),
    (["compare", ".", "--methods", "none,none"], "twice"),
    (["compare", ".", "--batch", "-1"], "whole numbers from 0 on"),
    (["compare", ".", "--every", "1.5"], "it is '1.5', allowed are whole numbers from 1 on"),
    (["pairs", ".", "--out", "o", "--per-video", "1.5"], "it is '1.5', allowed are whole numbers from 1 on"),
    (["train", ".", "--out", "o", "--devices", "1.4"], "it is '1.4', allowed are whole numbers from 1 on"),
    (["train", ".", "--out", "o", "--set", "seed=99999999999999999999999"], "seed: "),
    (["train", ".", "--out", "o", "--set", "loss"], "KEY=VALUE"),
    (["train", ".", "--out", "o", "--set", "loss.wings=2"], "loss.wings"),
    (["train", ".", "--out", "o", "--set", "steps=2", "--set", "steps=3"], "steps undoes the earlier steps"),
    (["train", ".", "--out", "o", "--steps", "0"], "steps"),
    (["train", ".", "--out", "o", "--config", "none.toml"], "none.toml"),
    (["train", ".", "--out", "o"], "no image pairs"),
])  # fmt: skip
def test_mistake_is_one_line_and_status_2(tmp_path: Path, monkeypatch, capsys, arguments: list[str], word: str) -> None:
    (tmp_path / "notes.txt").touch()
    monkeypatch.chdir(tmp_path)
    assert word in fails(capsys, *arguments)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt"]


def test_compare_and_predict_print_tables_files_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_synthetic(tmp_path / "data", [(2.0, 1.0)])
    text = said(capsys, main, "compare", folder, "--methods", "none,dis-fast", "--out", tmp_path / "out")
    assert "DIS fast" in text
    assert "000000" in text
    answer = json.loads(said(capsys, main, "compare", folder, "--methods", "none", "--json"))
    assert answer["methods"][0]["endpoint_error_px"] == pytest.approx(5**0.5, rel=1e-6)  # float32 flow
    folder = write_folder(tmp_path / "in", {"a": (1, 0)})
    tail = ["--out", tmp_path / "flow", "--method", "farneback"]
    assert "a.exr" in said(capsys, main, "predict", folder / "a_1.png", folder / "a_2.png", *tail)
    answer = json.loads(said(capsys, main, "predict", video(tmp_path / "v.avi"), *tail, "--json"))
    assert [motion["frame"] for motion in answer["motions"]] == [1, 2, 3]
    assert all(Path(file).is_file() for file in answer["files"])
    assert "b.flo" in said(capsys, main, "predict", write_folder(tmp_path / "two", {"b": (1, 0)}), *tail)


@pytest.mark.parametrize("width", [30, 60, 200])
def test_tables_fit_any_terminal_and_nothing_is_cut(
    monkeypatch, capsys: pytest.CaptureFixture[str], width: int
) -> None:
    header, names = ["method", *(f"pair {k:03d}" for k in range(30))], ["DIS [medium]", "a network (3 seeds)"]
    table = header, [[name, *(f"{number}.{k:03d}" for k in range(30))] for number, name in enumerate(names)]
    terminal.show_table("Each pair.", *table)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 7  # no terminal: one table, as wide as it is
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.setenv("FORCE_COLOR", "1")
    terminal.show_table("Each pair.", *table)
    lines = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    assert max(map(len, lines)) <= width
    words = " ".join(lines).split()
    assert {f"{number}.{k:03d}" for k in range(30) for number in (0, 1)} <= set(words)
    assert len(lines) > 7
    assert words.count("[medium]") == words.count("method")


def test_without_a_terminal_progress_is_a_line_now_and_then(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(terminal, "LINE_S", 0.0)
    with terminal.progress("pairs") as advance, terminal.progress("none", shown=False) as silent:
        silent(1, 3, "")
        advance(1, 3, "a")
        advance(2, 3, "")
        advance(3, 3, "c")
    assert capsys.readouterr() == ("", "gelflow: pairs: 1 of 3; a\ngelflow: pairs: 2 of 3\n")


def test_a_truncated_video_is_used_as_far_as_it_goes_and_said_to_be_so(tmp_path: Path, capfd) -> None:
    whole = video(tmp_path / "v.avi").read_bytes()
    (tmp_path / "v.avi").write_bytes(whole[: int(0.8 * len(whole))])
    command = ["predict", str(tmp_path / "v.avi"), "--out", str(tmp_path / "out"), "--method", "farneback", "--json"]
    assert main(command) == 0
    out, err = capfd.readouterr()
    answer = json.loads(out)
    assert len(answer["motions"]) + answer["lost"] == 3
    assert f"v.avi: about {answer['lost']} frames at its end do not decode" in err


def test_folders_that_cannot_be_used_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = tmp_path / "a_1.png", tmp_path / "a_2.png"
    save(one, moved(32, 32, 0, 0))
    save(two, moved(32, 40, 0, 0))
    assert "40 x 32" in fails(capsys, "compare", tmp_path, "--methods", "none")
    for out in (two, two / "x"):
        words = f"{out}: is a file or lies in one"
        assert words in fails(capsys, "predict", one, one, "--method", "farneback", "--out", out)


def test_pairs_exit_statuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """0 if every recording could be read, 1 if some could not, 2 if none could or no pair has motion."""
    good, bad = video(tmp_path / "good.avi"), tmp_path / "bad.avi"
    bad.write_bytes(b"junk" * 100)
    answer = json.loads(said(capsys, main, "pairs", good, "--out", tmp_path / "a", "--json"))
    motions = [pair["motion_px"] for pair in json.loads((tmp_path / "a" / "pairs.json").read_text())["pairs"]]
    assert (answer["recordings"], answer["pairs"] >= 2) == (1, True)
    deciles = answer["motion_deciles_px"]
    assert round(min(motions), 1) <= deciles[0] <= deciles[-1] <= round(max(motions), 1)
    assert main(["pairs", str(good), str(bad), "--out", str(tmp_path / "b")]) == 1
    captured = capsys.readouterr()
    assert "bad.avi" in captured.err
    assert " pairs from 1 recordings (0 without enough motion, 1 unreadable)" in captured.out
    assert "none of the 1 recordings" in said(capsys, main, "pairs", bad, "--out", tmp_path / "c", status=2)
    assert "little motion" in fails(capsys, "pairs", good, "--out", tmp_path / "d", "--min-motion", "50")
    assert "seed is 0 there and 1 here" in fails(capsys, "pairs", good, "--out", tmp_path / "a", "--seed", "1")


class Evil:
    """Pickled, it would make a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return (Path.touch, (self.path,))


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("networks")
    torch.save(RAFT(large=False, iterations=1).state_dict(), folder / "raft.pth")
    model = ModelConfig(levels=4, projected_channels=8)
    return random_weights(folder / "gelflow.safetensors", model), folder / "raft.pth"


def damaged(kind: str, good: Path, path: Path, trace: Path) -> None:
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
    command = ["train", folder, "--out", run, "--config", settings, "--device", "cpu"]
    said(capsys, main, *command)
    torch.save({"step": 0, "model": Evil(trace)}, run / "state.ckpt")
    assert "state.ckpt: damaged" in fails(capsys, *command, "--resume")
    assert not trace.exists()


@pytest.mark.parametrize("number", [0, 1], ids=["gelflow", "raft"])
def test_images_that_cannot_be_used_are_named(number: int, networks: tuple[Path, Path], tmp_path: Path, capsys) -> None:
    tail = ["--weights", networks[number], "--out", tmp_path / "out", "--device", "cpu"]
    for name, size in (("one", (1, 1)), ("small", (12, 80)), ("good", (64, 80)), ("wide", (64, 96))):
        save(tmp_path / f"{name}.png", moved(*size, 0, 0))
    good = moved(64, 80, 0, 0)
    broken = good.copy()
    broken[3, 4, 1] = np.nan
    assert cv2.imwrite(str(tmp_path / "nan.tiff"), broken)

    def predict(first: str, second: str, *options: str) -> str:
        return fails(capsys, "predict", tmp_path / first, tmp_path / second, *tail, *options)

    assert "one.png: 1 x 1 px" in predict("one.png", "good.png")
    assert "each side needs 16 px" in predict("small.png", "small.png")
    assert "--markers are for a video" in predict("good.png", "good.png", "--every", "2")
    assert "good.png has 80 x 64 px, " in predict("good.png", "wide.png")
    assert "nan.tiff" in predict("good.png", "nan.tiff")
    if number == 0:
        assert "--size" in predict("good.png", "good.png", "--size", "64")
        assert "32x64: each side must be at least 64 px" in predict("good.png", "good.png", "--size", "32x64")
    assert not (tmp_path / "out").exists()
