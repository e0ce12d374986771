"""Datasets under fsspec URLs: the same objects as the files of a directory, in one go or after any stop."""

import json
import os
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest
from commands import refused
from fsspec.implementations.memory import MemoryFileSystem
from samples import job, translation_sample
from tiny_scene import fingerprint, reference

from synth.dataset.lock import EXPIRES_S
from synth.dataset.manifest import Failure
from synth.dataset.sample_files import write_sample_files
from synth.dataset.shard import Shard
from synth.dataset.store import RemoteStore, open_store
from synth.dataset.writer import DatasetWriter
from synth.errors import InputError
from synth.pipeline.generate import Scheduling, generate
from synth.scene.template import load_scene

pytestmark = pytest.mark.usefixtures("one_cache")


@pytest.fixture
def url() -> Iterator[str]:
    place = f"memory://{uuid.uuid4().hex}/data"
    yield place
    fsspec.filesystem("memory").rm(place.removeprefix("memory:/").rpartition("/")[0], recursive=True)


def _download(url: str, folder: Path) -> Path:
    system, root = fsspec.core.url_to_fs(url)
    system.get(root, str(folder), recursive=True)
    return folder


def test_the_same_as_in_a_directory_in_shards_and_steps(url: str, tiny: Path, tmp_path: Path) -> None:
    template = load_scene(tiny)
    assert generate(template, 1, url).made == 1
    shard = generate(template, 5, url, scheduling=Scheduling(shard=Shard(0, 2)))
    assert (shard.asked_for, shard.found, shard.made) == (3, 1, 2)  # trajectories 0 and 2: samples 0 1 4
    rest = generate(template, 5, url)
    assert (rest.found, rest.made) == (3, 2)
    copy = _download(url, tmp_path / "copy")
    assert fingerprint(copy) == fingerprint(reference())
    assert json.loads((copy / "summary.json").read_text())["samples"] == 5


def test_a_stopped_run_leaves_a_journal_that_the_next_one_reads(url: str) -> None:
    writer = DatasetWriter(url, job(3))
    writer.record(write_sample_files(url, translation_sample(2), job()))
    writer.fail(Failure(1, 0, "simulate", "Newton failed"))
    write_sample_files(url, translation_sample(0), job())  # without its line: does not count
    writer.close()  # as a killed run, nothing finalised; but its lease is this process's, which lives
    store = RemoteStore(url)
    assert store.names("journal") == ["000001-0.json", "000002.json"]
    assert store.read("manifest.jsonl") is None
    with DatasetWriter(url, job(3)) as again:
        assert again.finished == {2}
        again.fail(Failure(1, 0, "simulate", "Newton failed"))  # known
        for index in (1, 0):
            again.record(write_sample_files(url, translation_sample(index), job()))
    assert store.names("journal") == []
    manifest = (store.read("manifest.jsonl") or b"").splitlines()
    assert [json.loads(line)["index"] for line in manifest] == [0, 1, 2]
    assert len((store.read("failures.jsonl") or b"").splitlines()) == 1


def test_lines_that_cannot_be_published_stay_in_the_journal(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("403 Forbidden")

    writer = DatasetWriter(url, job(1))
    writer.record(write_sample_files(url, translation_sample(0), job()))
    writer.run = {}
    with monkeypatch.context() as patch:
        patch.setattr(MemoryFileSystem, "put_file", refuse)
        refused(r"manifest\.jsonl: the storage refuses: RuntimeError: 403", writer.finalise)
    writer.close()
    assert RemoteStore(url).names("journal") == ["000000.json"]
    with DatasetWriter(url, job(1)) as again:
        assert again.finished == {0}
    assert RemoteStore(url).names("journal") == []
    assert len((RemoteStore(url).read("manifest.jsonl") or b"").splitlines()) == 1


def test_who_is_refused(url: str) -> None:
    with DatasetWriter(url, job()):
        for shard in (None, Shard(0, 2)):
            refused(rf"another process \(pid {os.getpid()} on .*\) is writing", DatasetWriter, url, job(), shard)
    with DatasetWriter(url, job(), Shard(0, 2)), DatasetWriter(url, job(), Shard(1, 2)):
        for shard in (None, Shard(1, 2)):
            refused("another process", DatasetWriter, url, job(), shard)
    refused("seed: 7 there, 8 now", DatasetWriter, url, job(seed=8))
    RemoteStore(url).delete(["dataset.json"])
    refused(r"holds .* but no dataset", DatasetWriter, url, job())


def test_meshes_are_put_under_the_url_but_not_by_a_shard(url: str) -> None:
    with DatasetWriter(url, job(), Shard(0, 2)) as writer:
        with pytest.raises(InputError, match="shards need the mesh to be there"), writer.making_meshes() as folder:
            (folder / "shard.npz").write_bytes(b"mesh")
        (folder / "shard.npz").unlink()
    with DatasetWriter(url, job()) as writer, writer.making_meshes() as folder:
        (folder / "plain.npz").write_bytes(b"mesh")
    assert RemoteStore(url).names("meshes") == ["plain.npz"]
    (folder / "plain.npz").unlink()
    assert (open_store(url).meshes() / "plain.npz").read_bytes() == b"mesh"  # fetched by another process


@pytest.mark.parametrize("place", ["url", "tmp_path"])
def test_a_sample_whose_files_are_elsewhere_is_refused(place: str, request: pytest.FixtureRequest) -> None:
    out = request.getfixturevalue(place)
    elsewhere = write_sample_files(request.getfixturevalue("tmp_path") / "elsewhere", translation_sample(1), job())
    with DatasetWriter(out if place == "url" else out / "d", job()) as writer:
        refused(r"samples/000001: the sample's files are not there", writer.record, elsewhere)
        assert writer.finished == set()


def test_a_killed_run_holds_nothing_for_long(url: str) -> None:
    expired = {"pid": 1, "host": "elsewhere", "time": time.time() - EXPIRES_S - 1}  # not renewed
    dead = {"pid": 2**22 + 1, "host": os.uname().nodename, "time": time.time()}  # beyond Linux's largest number
    DatasetWriter(url, job()).close()
    for note in (expired, dead):
        RemoteStore(url).write("leases/whole.json", json.dumps(note).encode())
        with DatasetWriter(url, job()):  # taken over
            assert json.loads(RemoteStore(url).read("leases/whole.json") or b"{}")["pid"] == os.getpid()


def test_storage_that_refuses_ends_with_one_message_and_goes_on(url: str, tiny: Path, tmp_path, monkeypatch) -> None:
    template = load_scene(tiny)
    generate(template, 2, url)

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("403 Forbidden")  # a driver's own error, no OSError

    with monkeypatch.context() as patch:
        patch.setattr(MemoryFileSystem, "put_file", refuse)
        refused(r"samples/000002: the storage refuses: RuntimeError: 403 Forbidden", generate, template, 5, url)
    assert generate(template, 5, url).found == 2
    assert fingerprint(_download(url, tmp_path / "copy")) == fingerprint(reference())


def test_places_that_cannot_be_are_told_and_a_file_url_is_a_directory(tiny: Path, tmp_path: Path) -> None:
    for out, workers, message in (
        ("nowhere://bucket/x", 2, "Protocol not known"),
        ("memory://x", 1, "is seen by one process only"),
    ):
        refused(message, generate, load_scene(tiny), 1, out, scheduling=Scheduling(workers))
    template = load_scene(tiny, ["motion.depth_mm=-1"])
    summary = generate(template, 1, f"file://{tmp_path}/with%20space")
    assert summary.directory == tmp_path / "with space"
    assert (tmp_path / "with space" / ".lock").exists()
