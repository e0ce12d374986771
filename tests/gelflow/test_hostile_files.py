"""Files that were made to harm: each is refused with one message, in time, and nothing is written elsewhere."""

import http.client
import io
import json
import os
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from commands import complaint, refused
from PIL import Image
from safetensors import safe_open
from safetensors.torch import save_file
from textures import moved, save

from gelflow.cli import main
from gelflow.data import PairDataset
from gelflow.files.exr import read_flow, write_flow
from gelflow.files.image import read_image
from gelflow.files.tensors import Unreadable, load_tensors
from gelflow.files.video import newest_frames
from gelflow.models.weights import load_weights, weights_file
from gelflow.predict.page import Page

OUTSIDE = ["/tmp/x", "../x", "a/../../x", "a\0b", "..\\x", ""]


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("key", ["name", "image1"])
def test_a_pair_set_names_nothing_outside_of_it(tmp_path: Path, capsys, key: str, name: str) -> None:
    for k in (1, 2):
        save(tmp_path / f"d/a_{k}.png", moved(32, 32, k, 0))
    pair = {"name": "a", "image1": "a_1.png", "image2": "a_2.png", "source": "s", "frames": [0, 1], "motion_px": 1.0}
    content = {"job": {}, "complete": True, "pairs": [pair | {key: name}]}
    (tmp_path / "d/pairs.json").write_text(json.dumps(content))
    words = complaint(capsys, main, "predict", tmp_path / "d", "--method", "farneback", "--out", tmp_path / "out/put")
    assert "leads out of its folder" in words
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["../../x.json", "/x.json", "a\0b.json"])
def test_a_shard_names_nothing_outside_of_it(tmp_path: Path, name: str) -> None:
    with tarfile.open(tmp_path / "a.tar", "w", format=tarfile.PAX_FORMAT) as archive:
        member = tarfile.TarInfo("x.json")
        member.pax_headers = {"path": name}
        archive.addfile(member, io.BytesIO())
    refused("leads out of its folder", PairDataset, tmp_path / "a.tar")


def test_a_shard_of_endless_headers_is_refused(tmp_path: Path) -> None:
    member = tarfile.TarInfo("././@LongLink")
    member.type = tarfile.GNUTYPE_LONGNAME
    (tmp_path / "a.tar").write_bytes(member.tobuf(tarfile.GNU_FORMAT) * 3000)
    refused("truncated, damaged", PairDataset, tmp_path / "a.tar")


def changed(path: Path, **texts: str) -> Path:
    with safe_open(str(weights_file(None)), framework="pt") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        save_file(tensors, str(path), file.metadata() | texts)
    return path


def model(**changes: object) -> str:
    with safe_open(str(weights_file(None)), framework="pt") as file:
        return json.dumps(json.loads(file.metadata()["model"]) | changes)


@pytest.mark.parametrize(("texts", "words"), [
    (lambda: {"image_size": "[20000, 20000]"}, "at most 3145728 px"),
    (lambda: {"image_size": "[-5, 70]"}, "at least 64 px"),
    (lambda: {"image_size": f"[{'9' * 5000}, 70]"}, "4300 digits"),
    (lambda: {"model": '{"a":' * 50_000}, "nested too deeply"),
    (lambda: {"model": model(registration={"windows_px": [1e6], "smoothing_px": [1]})}, "less than or equal to 1000"),
    (lambda: {"model": model(registration={"propagation_px": list(range(1, 99))})}, "at most 16 items"),
])  # fmt: skip
def test_what_weights_say_is_bounded(tmp_path: Path, texts: Callable[[], dict], words: str) -> None:
    refused(words, load_weights, changed(tmp_path / "w.safetensors", **texts()))


def test_flow_is_finite_flat_and_of_one_size(tmp_path: Path) -> None:
    field = np.full((8, 9, 2), np.inf, np.float32)
    write_flow(tmp_path / "a.exr", field)
    refused("more than 1e6 px", read_flow, tmp_path / "a.exr")
    planes = {f"forward.{name}": np.zeros((8, 9), np.float32) for name in "UV"}
    parts = [OpenEXR.Part({"name": name}, planes) for name in "ab"]
    OpenEXR.File(parts).write(str(tmp_path / "b.exr"))
    refused("not one flat image", read_flow, tmp_path / "b.exr")


def test_large_pictures_pipes_and_devices_are_not_read(tmp_path: Path) -> None:
    Image.new("1", (9000, 9000)).save(tmp_path / "a.png")
    refused("at most 67108864 px", read_image, tmp_path / "a.png")
    os.mkfifo(tmp_path / "pipe.avi")
    with pytest.raises(ValueError, match="is a pipe"):
        next(newest_frames(str(tmp_path / "pipe.avi")))
    (tmp_path / "zero.pth").symlink_to("/dev/zero")
    with pytest.raises(Unreadable, match="not a regular file"):
        load_tensors(tmp_path / "zero.pth")


@pytest.mark.parametrize(("text", "words"), [
    (f"steps = {'9' * 5000}", "4300 digits"), (f"steps = {'[' * 3000}", "nested too deeply"),
])  # fmt: skip
def test_a_configuration_is_bounded(tmp_path: Path, capsys, text: str, words: str) -> None:
    (tmp_path / "c.toml").write_text(text)
    for k in (1, 2):
        save(tmp_path / f"d/a_{k}.png", moved(64, 64, k, 0))
    train = ["train", tmp_path / "d", "--out", tmp_path / "out"]
    assert words in complaint(capsys, main, *train, "--config", tmp_path / "c.toml")
    assert words in complaint(capsys, main, *train, "--set", text.replace(" ", ""))
    assert "in one line" in complaint(capsys, main, *train, "--set", "steps=3\nseed=1")


def test_the_page_answers_to_this_machine_s_names_alone() -> None:
    """A page of another name would be a stranger's, whose name was made to mean this machine."""
    page = Page(0)
    page.show(np.zeros((8, 8, 3), np.uint8))
    port = int(page.address.rpartition(":")[2])
    try:
        for host, status in ((f"localhost:{port}", 200), ("127.0.0.1:1", 200), ("evil.example", 403), ("", 403)):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
            connection.request("GET", "/", headers={"Host": host})
            assert connection.getresponse().status == status
            connection.close()
    finally:
        page.close()
