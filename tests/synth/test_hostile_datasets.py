"""Files that were made to harm: each is refused with one message, in time, and nothing is written elsewhere."""

import hashlib
import json
import os
import re
import shutil
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import complaint, refused
from samples import translation_sample, write_dataset

from synth.cli import main
from synth.dataset.exr import write_flow
from synth.dataset.images import read_png
from synth.dataset.lock import EXPIRES_S, Lease
from synth.dataset.sample_reader import read_sample
from synth.dataset.store import RemoteStore
from synth.errors import printable
from synth.flow.field import FlowField
from synth.scene.template import MOST_OPTIONS, load_scene
from synth.untrusted import MOST_FOLDERS, inside, matching_files, open_file, parsed, read_file
from synth.verify import verify_dataset

Harm = Callable[[Path], object]
"""Harms a sample's folder."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("sound") / "d", [translation_sample(0)], 1)


def arrays(**changes: Callable[[np.ndarray], np.ndarray]) -> Harm:
    def harm(folder: Path) -> None:
        with np.load(folder / "surface.npz") as found:
            content = dict(found)
        for name, change in changes.items():
            content[name] = change(content[name])
        np.savez(folder / "surface.npz", **content)

    return harm


def flow(value: float) -> Harm:
    def harm(folder: Path) -> None:
        field = np.full((24, 32, 2), value, np.float32)
        write_flow(folder / "flow.exr", FlowField(field, np.ones((24, 32), np.float32)), {})

    return harm


def meta(**changes: object) -> Harm:
    def harm(folder: Path) -> None:
        content = json.loads((folder / "meta.json").read_text())
        (folder / "meta.json").write_text(json.dumps({**content, **changes}))

    return harm


def special(name: str, made: Callable[[Path], object]) -> Harm:
    def harm(folder: Path) -> None:
        (folder / name).unlink()
        made(folder / name)

    return harm


def listed(name: str) -> Harm:
    def harm(folder: Path) -> None:
        manifest = folder.parents[1] / "manifest.jsonl"
        line = json.loads(manifest.read_text())
        line["sha256"][name] = "0" * 64
        manifest.write_text(json.dumps(line) + "\n")

    return harm


def vast_window(folder: Path) -> None:
    content = bytearray((folder / "flow.exr").read_bytes())
    at = content.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4 + 8
    content[at : at + 8] = struct.pack("<ii", 10**9, 10**9)
    (folder / "flow.exr").write_bytes(content)


def png(width: int, height: int) -> bytes:
    """A picture of that size by its header, with no pixels in it."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


HARMS: dict[str, tuple[Harm, str]] = {
    "infinite flow": (flow(np.inf), "flow must be below 1e6 px"),
    "endless flow": (flow(3e38), "flow must be below 1e6 px"),
    "window": (vast_window, "not one flat image of at most"),
    "indices": (arrays(faces=lambda faces: faces + 10**6), "are no surface"),
    "subdivisions": (arrays(subdivisions=lambda _: np.array(10**6)), "are no surface"),
    "shape": (arrays(nodes=lambda nodes: nodes[:, :2]), "are no surface"),
    "not finite": (arrays(displacement1=lambda moved: moved * np.nan), "are no surface"),
    "meta": (meta(force_n="strong"), "force_n"),
    "camera": (meta(scene={"sensor": {"further_cameras": [{"name": "../.."}]}}), "leads out of its folder"),
    "deep": (lambda folder: (folder / "meta.json").write_text("[" * 100_000), "nested too deeply"),
    "pipe": (special("flow.exr", os.mkfifo), "a pipe or a device"),
    "device": (special("image1.png", lambda path: path.symlink_to("/dev/zero")), "a pipe or a device"),
    "pixels": (lambda folder: (folder / "image1.png").write_bytes(png(20_000, 20_000)), "more than .* pixels"),
}


@pytest.mark.parametrize("name", HARMS)
def test_a_harmed_sample_is_condemned_and_others_refuse_it(sound: Path, tmp_path: Path, capsys, name: str) -> None:
    harm, words = HARMS[name]
    shutil.copytree(sound, tmp_path / "d")
    harm(tmp_path / "d/samples/000000")
    refused(words, read_sample, tmp_path / "d/samples/000000")
    assert main(["verify", str(tmp_path / "d"), "--json"]) == 1
    (checked,) = json.loads(capsys.readouterr().out)["samples"]
    assert re.search(words, checked["checks"][0]["detail"])
    if name not in ("indices", "subdivisions", "shape", "not finite"):  # inspect looks at no surface
        assert re.search(words, complaint(capsys, main, "inspect", tmp_path / "d"))
    export = ["export", tmp_path / "d", "--format", "npz", "--out", tmp_path / "o"]
    assert re.search(words, complaint(capsys, main, *export))
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("name", ["/dev/zero", "../../manifest.jsonl", "a\0b"])
def test_the_manifest_names_no_file_outside_of_the_sample(sound: Path, tmp_path: Path, name: str) -> None:
    shutil.copytree(sound, tmp_path / "d")
    listed(name)(tmp_path / "d/samples/000000")
    detail = verify_dataset(tmp_path / "d").samples[0].checks[0].detail
    assert f"{name!r} leads out of its folder" in detail


def test_a_picture_without_gel_is_condemned(sound: Path, tmp_path: Path) -> None:
    shutil.copytree(sound, tmp_path / "d")
    flow(np.nan)(tmp_path / "d/samples/000000")
    scene = json.loads((tmp_path / "d/samples/000000/meta.json").read_text())["scene"]
    scene["sensor"]["pattern"] = {"kind": "speckle", "grain_mm": 0.5}  # so that the images are compared, too
    meta(scene=scene)(tmp_path / "d/samples/000000")
    checks = {check.name: check for check in verify_dataset(tmp_path / "d").samples[0].checks}
    assert not checks["forward flow"].passed
    assert "no pixel of the picture sees the gel" in checks["forward flow"].detail


def test_a_torn_surface_takes_no_memory(sound: Path, tmp_path: Path) -> None:
    """Two thousand triangles lie over most of the picture each."""
    shutil.copytree(sound, tmp_path / "d")
    rng = np.random.default_rng(0)
    nodes, rest = rng.uniform(-9, 9, (200, 3)) * (1, 1, 0.1), lambda _: np.zeros((200, 3))
    faces = np.argsort(rng.random((2000, 200)), axis=1)[:, :3]
    harm = arrays(nodes=lambda _: nodes, faces=lambda _: faces, displacement1=rest, displacement2=rest)
    harm(tmp_path / "d/samples/000000")
    detail = " ".join(check.detail for check in verify_dataset(tmp_path / "d").samples[0].checks)
    assert "lie over one another" in detail


DEEP, LONG = "[" * 3000, "9" * 5000
SCENES = {
    "deep": (f"depth_mm = {DEEP}", "nested too deeply"),
    "choices": (f"depth_mm = {'{choice=[' * 900}1{']}' * 900}", "nested too deeply"),
    "digits": (f"depth_mm = {LONG}", "4300 digits"),
    "hexadecimal": (f"depth_mm = 0x{'f' * 5000}", "4300 digits"),
    "line": (".".join("a" * 6000) + " = 1", "more than 10000 characters"),
    "options": ("depth_mm = { choice = [" + "0.4,\n" * (MOST_OPTIONS + 1) + "] }", f"allowed are {MOST_OPTIONS}"),
}


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_bounded(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    text, words = SCENES[name]
    path = tmp_path / "s.toml"
    path.write_text(f'extends = "gelsight_mini"\n[motion]\n{text}\n')
    assert words in complaint(capsys, main, "plan", "--scene", path)


@pytest.mark.parametrize(("assignment", "words"), [
    (f"motion.depth_mm={DEEP}", "nested too deeply"), (f"motion.depth_mm={LONG}", "4300 digits"),
    ("motion.depth_mm=1\n[sensor]\nx=1", "in one line"), (".".join("a" * 3000) + "=1", "give key=value"),
])  # fmt: skip
def test_an_assignment_is_bounded(capsys: pytest.CaptureFixture[str], assignment: str, words: str) -> None:
    assert words in complaint(capsys, main, "plan", "--set", assignment)


def test_wildcards_do_not_go_through_a_disk(tmp_path: Path) -> None:
    for name in ("a/b.stl", "a/.hidden.stl", "c/d/e.stl"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "c/loop").symlink_to(tmp_path)
    assert matching_files(tmp_path, "**/*.stl", [MOST_FOLDERS]) == ["a/b.stl", "c/d/e.stl"]
    assert matching_files(tmp_path, f"{tmp_path}/a/[a-b].*", [MOST_FOLDERS]) == [str(tmp_path / "a/b.stl")]
    refused("more than .* folders", matching_files, tmp_path, "*/*.stl", [4])
    assert matching_files(tmp_path, "a\0*", [MOST_FOLDERS]) == []


def test_a_bitmap_is_bounded_before_it_is_decoded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "big.png").write_bytes(png(20_000, 20_000))
    pattern = f'sensor.pattern={{ kind = "bitmap", file = "{tmp_path}/big.png", width_mm = 9 }}'
    words = complaint(capsys, main, "generate", "--n", 1, "--set", pattern, "--out", tmp_path / "out")
    assert "more than 33554432 pixels" in words
    assert "more than 67108864 pixels" in complaint(
        capsys, main, "calibrate", "--frames", tmp_path / "big.png", "--out", tmp_path / "out"
    )


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_a_lock_that_is_a_link_is_not_followed(tmp_path: Path, link: Callable[[Path, Path], None]) -> None:
    (tmp_path / "d").mkdir()
    (tmp_path / "mine").write_text("kept")
    link(tmp_path / "mine", tmp_path / "d/.lock")
    refused(r"\.lock: .*is a link", write_dataset, tmp_path / "d", [])
    assert (tmp_path / "mine").read_text() == "kept"


def test_a_dataset_whose_parts_are_links_is_not_written(sound: Path, tmp_path: Path) -> None:
    shutil.copytree(sound, tmp_path / "d")
    (tmp_path / "d/manifest.jsonl").rename(tmp_path / "mine")
    (tmp_path / "d/manifest.jsonl").symlink_to(tmp_path / "mine")
    before = (tmp_path / "mine").read_bytes()
    refused("manifest.jsonl: is a link", write_dataset, tmp_path / "d", [translation_sample(1)], 2)
    assert (tmp_path / "mine").read_bytes() == before


@pytest.mark.parametrize(("ahead_s", "held"), [(0.5 * EXPIRES_S, True), (2 * EXPIRES_S, False), (1e300, False)])
def test_a_lease_of_the_future_is_none(ahead_s: float, held: bool) -> None:
    store = RemoteStore(f"memory://lease-{hashlib.sha256(repr(ahead_s).encode()).hexdigest()}")
    note = {"pid": 1, "host": "elsewhere", "time": time.time() + ahead_s}
    store.write("leases/whole.json", json.dumps(note).encode())
    lease = Lease(store)
    if held:
        refused("another process", lease.join(None).__enter__)
        return
    with lease.join(None):
        assert json.loads(store.read("leases/whole.json") or b"{}")["pid"] == os.getpid()
    lease.release()


def test_what_a_terminal_would_obey_is_written_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert printable("a\x1b[2J\nb\u202e\udcff µ") == "a\\x1b[2J\nb\\u202e\\udcff µ"
    assert "\\x1b[31m" in complaint(capsys, main, "verify", tmp_path / "\x1b[31m")


def test_only_regular_files_of_bounded_size_are_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1234")
    assert read_file(tmp_path / "a", 4) == b"1234"
    with pytest.raises(OSError, match="larger than 3 bytes"):
        read_file(tmp_path / "a", 3)
    with pytest.raises(OSError, match="not a regular file"):
        open_file(tmp_path)
    cv2.imwrite(str(tmp_path / "whole.png"), np.zeros((4, 5), np.uint8))
    assert read_png(tmp_path / "whole.png").shape == (4, 5)
    assert inside("a/b.png") == "a/b.png"
    assert parsed(json.loads, b'{"a": [1, 2.5]}', "a") == {"a": [1, 2.5]}
    assert load_scene("deltact").name == "deltact"
