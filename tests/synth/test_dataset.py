"""Writing a dataset in one go, in several, with workers, in shards side by side, and into the wrong place."""

import errno
import json
import os
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused, said
from samples import job, translation_sample, tree, write, write_dataset, writing_elsewhere
from tiny_scene import fingerprint

from synth.cli import main
from synth.dataset import manifest
from synth.dataset.manifest import Failure
from synth.dataset.npz import encode_npz
from synth.dataset.reader import read_dataset
from synth.dataset.sample_files import write_sample_files
from synth.dataset.shard import Shard
from synth.dataset.writer import DatasetWriter
from synth.sampling import draw
from synth.scene.template import load_scene

PAIRS = 2  # Samples 0 1 | 2 3 | 4 5: with two shards, 0 and 1 and 4 and 5 are of shard 0/2, 2 and 3 of shard 1/2
N = 6


def _write_all(directory: Path, order: tuple[int, ...] = (0, 1, 2)) -> None:
    write_dataset(directory, map(translation_sample, order))


@pytest.mark.parametrize(("dtype", "grey"), [(np.uint8, False), (np.uint16, False), (np.uint16, True)])
def test_round_trip(tmp_path, dtype, grey):
    sample = translation_sample(2, dtype=dtype, grey=grey)
    dataset = read_dataset(write_dataset(tmp_path / "d", [sample]))
    assert dataset.samples == [2]
    assert dataset.scene_of(2) == sample.scene
    data = dataset.read(2)
    for name in ("image1", "image2", "displacement1", "displacement2"):
        np.testing.assert_array_equal(getattr(data, name), getattr(sample, name), strict=True)
    np.testing.assert_array_equal(data.flow.backward, sample.flow.backward, strict=True)
    moved = (one.surface.positions(one.displacement2) for one in (data, sample))
    np.testing.assert_array_equal(*moved, strict=True)
    (iterated,) = dataset
    assert len(dataset) == 1
    assert iterated.images[1] is iterated.image2
    for name in ("forward", "backward"):
        np.testing.assert_array_equal(getattr(iterated, name), getattr(sample.flow, name), strict=True)
    np.testing.assert_array_equal(iterated.visible, sample.flow.forward_visible, strict=True)
    entry = dataset.entry(2)
    assert (entry.max_flow_px, entry.force_n[1], entry.frames) == (np.hypot(1.25, 0.5), (0.1, 0.0, 1.5), (0, 3))
    assert entry.diagnostics["solver"][1]["depth_mm"] == 0.2
    assert set(entry.sha256) == {"image1.png", "image2.png", "flow.exr", "meta.json", "surface.npz"}
    assert dataset.check_hashes(2) == []
    bits, channels = 8 * np.dtype(dtype).itemsize, 1 if grey else 3
    assert data.meta["image"] == {"width": 32, "height": 24, "channels": channels, "bits": bits}


BEFORE = ("dome_radius_mm", "radius_mm", "thickness_mm", "outer", "window", "unit")
"""Fields that a record of an earlier version has for all gels: null where they are another shape's."""


@pytest.mark.parametrize(("name", "gel"), [
    ("gelsight_mini", {}),
    ("gelsight_mini", {"shape": "dome", "dome_radius_mm": 900.0}),
    ("densetact", {"size_mm": [25.0, 25.0, 12.5]}),
])  # fmt: skip
def test_a_record_with_all_shapes_fields_is_the_same_scene(tmp_path: Path, name: str, gel: dict[str, Any]) -> None:
    own = {key: value for key, value in gel.items() if key != "size_mm"}
    scene = draw(load_scene(name, set=[f"sensor.gel.{key}={value}" for key, value in own.items()]), 0, 0)
    path = write_dataset(tmp_path / "d", [translation_sample(2)]) / "samples/000002/meta.json"
    record = {**json.loads(path.read_text()), "scene": json.loads(scene.model_dump_json())}
    unused = {
        **dict.fromkeys(BEFORE),
        "length_mm": 0.0,
        "cut_end": "free",
        "rotation_deg": [0.0, 0.0, 0.0],
        "digest": "",
    }
    record["scene"]["sensor"]["gel"] = {**unused, **record["scene"]["sensor"]["gel"], **gel}
    record["scene"]["sensor"]["window"] = {
        "radius_mm": None,
        "center_z_mm": None,
        **record["scene"]["sensor"]["window"],
    }
    path.write_text(json.dumps(record))
    assert read_dataset(tmp_path / "d").scene_of(2) == scene
    path.write_text(json.dumps(record).replace('"length_mm": 0.0', '"length_mm": 0.0, "hardness": 3'))
    refused("its scene does not fit this version of synth", read_dataset(tmp_path / "d").scene_of, 2)


def test_a_dataset_tells_its_job_passes_over_half_a_line_and_finds_tampering(tmp_path) -> None:
    _write_all(tmp_path / "d")
    info = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert (info["schema_version"], info["scene"]["name"], info["device"]["variant"]) == (1, "flat", "scalar_rgb")
    assert (info["seed"], info["n"], info["software"]) == (7, 3, {"synth": "0.1.0"})
    assert "I1(x) = I2(x + forward(x))" in info["conventions"]["flow.directions"]
    with (tmp_path / "d" / "manifest.jsonl").open("a") as file:
        file.write('{"index": 3, "tra')
    assert read_dataset(tmp_path / "d").samples == [0, 1, 2]
    dataset, folder = read_dataset(tmp_path / "d"), tmp_path / "d" / "samples" / "000001"
    data = (folder / "flow.exr").read_bytes()
    (folder / "flow.exr").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    (folder / "image2.png").unlink()
    changed, lost = dataset.check_hashes(1)
    assert "flow.exr: sha256 is" in changed
    assert "image2.png: cannot be read" in lost
    assert dataset.check_hashes(0) == []


def test_order_and_interruptions_leave_no_trace(tmp_path):
    """Bitwise the same dataset: in one go; out of order; in three goes, of which one was killed in the worst places."""
    _write_all(tmp_path / "a")
    _write_all(tmp_path / "b", order=(2, 0, 1))
    killed = DatasetWriter(tmp_path / "c", job(1))
    write(killed, translation_sample(2))
    killed.fail(Failure(1, 0, "simulate", "Newton failed"))
    write_sample_files(tmp_path / "c", translation_sample(0), job())  # Whole, but without its line.
    stale = tmp_path / "c" / "samples" / ".000001.partial-99"
    stale.mkdir()
    (stale / "image1.png").write_bytes(b"half")
    with (tmp_path / "c" / "manifest.jsonl").open("a") as file:
        file.write('{"index": 0, "trajec')
    killed.close()
    with DatasetWriter(tmp_path / "c", job(3)) as writer:
        assert writer.finished == {2}
        assert not stale.exists()
        writer.fail(Failure(1, 0, "simulate", "Newton failed"))
        for index in (1, 0, 1):  # once more: recorded once
            write(writer, translation_sample(index))
    assert (tmp_path / "b" / "failures.jsonl").read_bytes() == b""
    for name in "ab":
        with DatasetWriter(tmp_path / name, job()) as writer:
            writer.fail(Failure(1, 0, "simulate", "Newton failed"))
    a, b, c = (fingerprint(tmp_path / name) for name in "abc")
    assert a == b == c
    assert len(read_dataset(tmp_path / "c").failures) == 1
    assert not [name for name in c if "partial" in name]


def test_lost_folder_is_made_again_and_n_may_grow_and_shrink(tmp_path):
    _write_all(tmp_path / "d")
    before = tree(tmp_path / "d")
    (tmp_path / "d" / "samples" / "000001" / "flow.exr").unlink()
    with DatasetWriter(tmp_path / "d", job()) as writer:
        assert writer.finished == {0, 2}
        write(writer, translation_sample(1))
    assert tree(tmp_path / "d") == before
    for n, expected in ((5, 5), (2, 5)):
        with DatasetWriter(tmp_path / "d", job(n)) as writer:
            assert writer.finished == {0, 1, 2}
        assert read_dataset(tmp_path / "d").info["n"] == expected


@pytest.mark.parametrize(("other", "named"), [
    (job(seed=8), r"seed: 7 there, 8 now"),
    (job(motion={"depth_mm": 0.3}), r"scene\.motion\.depth_mm: 0\.1 there, 0\.3 now"),
    (job(render={"max_depth": 2}), r"scene\.render: None there"),
    (replace(job(), device={"variant": "llvm_ad_rgb"}), r"device\.variant: scalar_rgb there, llvm_ad_rgb now"),
])  # fmt: skip
def test_another_job_is_refused_and_named(tmp_path, other, named):
    _write_all(tmp_path / "d")
    before = tree(tmp_path / "d")
    refused(named, DatasetWriter, tmp_path / "d", other)
    assert tree(tmp_path / "d") == before
    DatasetWriter(tmp_path / "d", job()).close()  # The refused writer holds no lock.


def test_other_software_is_recorded(tmp_path):
    _write_all(tmp_path / "d")
    for _ in range(2):
        DatasetWriter(tmp_path / "d", replace(job(), software={"synth": "0.2.0"})).close()
    info = read_dataset(tmp_path / "d").info
    assert (info["software"], info["continued_with"]) == ({"synth": "0.1.0"}, [{"synth": "0.2.0"}])


def _full(*_: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_full_disk_in_the_manifest(tmp_path, monkeypatch, call):
    """The line is half on the disk when the space ends: it is taken back."""
    with DatasetWriter(tmp_path / "d", job()) as writer:
        write(writer, translation_sample(0))
        entry = write_sample_files(tmp_path / "d", translation_sample(1), job())
        before = tree(tmp_path / "d")
        whole = os.write
        with monkeypatch.context() as patch:
            if call == "write":
                patch.setattr(manifest.os, "write", lambda descriptor, line: whole(descriptor, line[:20]))
            else:
                patch.setattr(manifest.os, "fsync", _full)
            refused(r"manifest\.jsonl: cannot be written: No space left", writer.record, entry)
        assert tree(tmp_path / "d") == before
        assert writer.finished == {0}


def test_unreadable_datasets_are_named(tmp_path):
    refused("no such directory", read_dataset, tmp_path / "none")
    refused(r"has no dataset\.json", read_dataset, tmp_path)
    _write_all(tmp_path / "d")
    refused(r"no finished sample 7; it has 0 to 2 \(3 of 3\)", read_dataset(tmp_path / "d").read, 7)
    for name, damage, message in (
        ("samples/000000/image1.png", lambda data: data[:100], r"000000/image1\.png.*truncated"),
        ("samples/000000/flow.exr", lambda data: data[:-40], r"000000/flow\.exr.*truncated"),
        ("samples/000000/surface.npz", lambda data: data[:-40], r"000000/surface\.npz"),
        ("samples/000000/surface.npz", lambda _: encode_npz({}), r"000000/surface\.npz: lacks the array"),
        ("samples/000000/meta.json", lambda data: data[:-40], r"000000/meta\.json.*not valid JSON"),
        ("samples/000000/meta.json", lambda _: b'{"scene": 3}', r"000000/meta\.json: scene"),
        ("dataset.json", lambda data: data.replace(b'"seed": ', b'"seed": "a", "before": '), "the value of seed is of"),
        ("manifest.jsonl", lambda data: data.replace(b'"sha256": {', b'"sha256": 3, "before": {'), "is damaged"),
    ):
        file = tmp_path / "d" / name
        whole = file.read_bytes()
        file.write_bytes(damage(whole))
        refused(message, lambda: read_dataset(tmp_path / "d").read(0))
        file.write_bytes(whole)
    info = tmp_path / "d" / "dataset.json"
    info.write_text(info.read_text().replace('"schema_version": 1', '"schema_version": 9'))
    refused("version 9 of the format", read_dataset, tmp_path / "d")


def _in_one_go(directory: Path) -> dict[str, object]:
    with DatasetWriter(directory, job(N)) as writer:
        _make(writer, range(N))
    return fingerprint(directory)


def _make(writer: DatasetWriter, indices: Iterable[int]) -> None:
    for index in indices:
        write(writer, translation_sample(index))
        if index == 4:
            writer.fail(Failure(4, 0, "simulate", "Newton failed"))


def test_one_after_the_other(tmp_path: Path) -> None:
    expected = _in_one_go(tmp_path / "one")
    for shard, own in (("1/2", [2, 3]), ("0/2", [0, 1, 4, 5])):
        with DatasetWriter(tmp_path / "d", job(N), Shard.parse(shard), PAIRS) as writer:
            assert writer.finished == set()
            _make(writer, own)
        assert not (tmp_path / "d" / "shards").exists()  # a whole dataset at any time that nobody writes
    assert fingerprint(tmp_path / "d") == expected
    with DatasetWriter(tmp_path / "d", job(N), Shard(0, 2), PAIRS) as writer:
        assert writer.finished == {0, 1, 4, 5}


def test_the_last_to_leave_joins(tmp_path: Path) -> None:
    expected = _in_one_go(tmp_path / "one")
    with writing_elsewhere(tmp_path / "d", "0/2", [0, 1, 4]) as other:
        with DatasetWriter(tmp_path / "d", job(N), Shard(1, 2), PAIRS) as writer:
            stale = tmp_path / "d" / "samples" / ".000000.partial-1"  # of the other: it may be writing it
            own = tmp_path / "d" / "samples" / ".000002.partial-1"
            stale.mkdir()
            _make(writer, [2, 3])
        assert stale.exists()
        own.mkdir()
        assert read_dataset(tmp_path / "d").samples == []  # not yet: the other runs
        with DatasetWriter(tmp_path / "d", job(N), Shard(1, 2), PAIRS) as writer:
            assert writer.finished == {2, 3}
            assert not own.exists()
        stale.rmdir()
        other.communicate("go\n")
        assert other.returncode == 0
    assert read_dataset(tmp_path / "d").samples == [0, 1, 2, 3, 4]
    with DatasetWriter(tmp_path / "d", job(N), Shard(0, 2), PAIRS) as writer:
        assert writer.finished == {0, 1, 4}
        _make(writer, [5])
        writer.fail(Failure(4, 0, "simulate", "Newton failed"))
    assert fingerprint(tmp_path / "d") == expected


def test_a_killed_shard_is_taken_in_by_whoever_is_next(tmp_path: Path) -> None:
    """Its lines, also when the last one is torn; a stop in the middle of joining counts no line twice."""
    expected = _in_one_go(tmp_path / "one")
    with writing_elsewhere(tmp_path / "d", "0/2", [0, 1]):
        pass
    home = tmp_path / "d" / "shards" / "0-of-2"
    lines = (home / "manifest.jsonl").read_bytes()
    (tmp_path / "d" / "manifest.jsonl").write_bytes(lines)  # as a joining that was killed before it removed the folder
    with (home / "manifest.jsonl").open("a") as file:
        file.write('{"index": 4, "tra')
    with DatasetWriter(tmp_path / "d", job(N)) as writer:
        assert writer.finished == {0, 1}
        _make(writer, [2, 3, 4, 5])
    assert fingerprint(tmp_path / "d") == expected


def test_who_is_refused_beside_a_shard(tmp_path: Path) -> None:
    directory = tmp_path / "d"
    with writing_elsewhere(directory, "0/2", [0]) as other:
        before = tree(directory)
        for asked, shard, message in (
            (job(N), None, r"another process \(shards\) is writing this dataset"),
            (job(N), Shard(0, 2), rf"another process \(pid {other.pid} on .*\) is making shard 0/2"),
            (job(N), Shard(1, 3), r"is being made in another number of shards \(0-of-2\)"),
            (job(N, seed=8), Shard(1, 2), "seed: 7 there, 8 now"),
        ):
            refused(message, DatasetWriter, directory, asked, shard, PAIRS)
        assert tree(directory) == before
        DatasetWriter(directory, job(N), Shard(1, 2), PAIRS).close()
    DatasetWriter(directory, job(N), Shard(1, 3), PAIRS).close()  # once the others have ended


def test_wrong_shards_are_refused_and_right_ones_cover_each_trajectory_once(tmp_path: Path, capsys) -> None:
    for text in ("", "1", "2/2", "-1/2", "0/0", "1/x", "0.5/2", "a0/2"):
        refused(r"--shard .*: give i/N with 0 <= i < N", Shard.parse, text)
    words = said(capsys, main, "generate", "--out", tmp_path / "d", "--shard", "2/2", status=2)
    assert "--shard 2/2: give i/N with 0 <= i < N, such as 0/16; the last of 2 is 1/2" in words
    assert list(tmp_path.iterdir()) == []
    for count in (1, 2, 3, 7):
        for trajectory in range(20):
            assert sum(Shard(number, count).makes(trajectory) for number in range(count)) == 1
