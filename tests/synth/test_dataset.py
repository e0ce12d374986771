"""Writing a dataset in one go, in several, with workers, and into the wrong place."""

import errno
import json
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from samples import job, translation_sample, tree

from synth.dataset import lines, sample_files
from synth.dataset.reader import read_dataset
from synth.dataset.sample_files import write_sample_files
from synth.dataset.writer import DatasetWriter
from synth.errors import InputError


def _write_all(directory: Path, order=(0, 1, 2), n: int = 3) -> None:
    with DatasetWriter(directory, job(n)) as writer:
        for index in order:
            writer.write(translation_sample(index))


def _without_seconds(files: dict[str, bytes]) -> dict[str, object]:
    entries = [json.loads(line) for line in files["manifest.jsonl"].splitlines()]
    return {**files, "manifest.jsonl": [{**entry, "seconds": None} for entry in entries]}


@pytest.mark.parametrize(("dtype", "grey"), [(np.uint8, False), (np.uint16, False), (np.uint16, True)])
def test_round_trip(tmp_path, dtype, grey):
    sample = translation_sample(2, dtype=dtype, grey=grey)
    with DatasetWriter(tmp_path / "d", job()) as writer:
        writer.write(sample)
    dataset = read_dataset(tmp_path / "d")
    assert dataset.samples == [2]
    assert dataset.scene_of(2) == sample.scene
    data = dataset.read(2)
    for name in ("image1", "image2", "displacement1", "displacement2"):
        np.testing.assert_array_equal(getattr(data, name), getattr(sample, name), strict=True)
    np.testing.assert_array_equal(data.flow.backward, sample.flow.backward, strict=True)
    (iterated,) = dataset
    assert len(dataset) == 1
    assert iterated.images[1] is iterated.image2
    for name in ("forward", "backward"):
        np.testing.assert_array_equal(getattr(iterated, name), getattr(sample.flow, name), strict=True)
    np.testing.assert_array_equal(iterated.visible, sample.flow.forward_visible, strict=True)
    np.testing.assert_array_equal(
        data.surface.positions(data.displacement2), sample.surface.positions(sample.displacement2), strict=True
    )
    entry = dataset.entry(2)
    assert entry.max_flow_px == np.hypot(1.25, 0.5)
    assert entry.force_n[1] == (0.1, 0.0, 1.5)
    assert entry.frames == (0, 3)
    assert entry.diagnostics["solver"][1]["depth_mm"] == 0.2
    assert set(entry.sha256) == {"image1.png", "image2.png", "flow.exr", "meta.json", "surface.npz"}
    assert dataset.check_hashes(2) == []
    assert data.meta["image"] == {
        "width": 32, "height": 24, "channels": 1 if grey else 3, "bits": 8 * np.dtype(dtype).itemsize,
    }  # fmt: skip


def test_dataset_json_holds_the_job(tmp_path):
    _write_all(tmp_path / "d")
    info = json.loads((tmp_path / "d" / "dataset.json").read_text())
    assert info["schema_version"] == 1
    assert info["scene"]["name"] == "flat"
    assert (info["seed"], info["n"], info["software"]) == (7, 3, {"synth": "0.1.0"})
    assert info["device"]["variant"] == "scalar_rgb"
    assert "I1(x) = I2(x + forward(x))" in info["conventions"]["flow.directions"]


def test_order_and_interruptions_leave_no_trace(tmp_path):
    """Bitwise the same dataset: in one go; out of order; in three goes, of which one was killed in the worst places."""
    _write_all(tmp_path / "a")
    _write_all(tmp_path / "b", order=(2, 0, 1))
    killed = DatasetWriter(tmp_path / "c", job(1))
    killed.write(translation_sample(2))
    killed.fail(1, 0, "simulate", "Newton failed")
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
        writer.fail(1, 0, "simulate", "Newton failed")
        for index in (1, 0):
            writer.write(translation_sample(index))
    with DatasetWriter(tmp_path / "a", job()) as writer:
        writer.fail(1, 0, "simulate", "Newton failed")
    a, b, c = (_without_seconds(tree(tmp_path / name)) for name in "abc")
    assert a == c
    assert {**a, "failures.jsonl": b""} == b
    assert len(read_dataset(tmp_path / "c").failures) == 1
    assert not [name for name in c if "partial" in name]


def test_workers_write_and_the_driver_records(tmp_path):
    _write_all(tmp_path / "a", n=4, order=range(4))
    context = get_context("spawn")
    with DatasetWriter(tmp_path / "b", job(4)) as writer, ProcessPoolExecutor(2, mp_context=context) as pool:
        futures = [pool.submit(write_sample_files, tmp_path / "b", translation_sample(i), job(4)) for i in (3, 1, 0, 2)]
        for future in futures:
            writer.record(future.result())
            writer.record(future.result())  # Told twice: recorded once.
    assert _without_seconds(tree(tmp_path / "a")) == _without_seconds(tree(tmp_path / "b"))


def test_lost_folder_is_made_again(tmp_path):
    _write_all(tmp_path / "d")
    before = tree(tmp_path / "d")
    (tmp_path / "d" / "samples" / "000001" / "flow.exr").unlink()
    with DatasetWriter(tmp_path / "d", job()) as writer:
        assert writer.finished == {0, 2}
        writer.write(translation_sample(1))
    assert tree(tmp_path / "d") == before


def test_n_may_grow_and_shrink(tmp_path):
    _write_all(tmp_path / "d")
    for n, expected in ((5, 5), (2, 5)):
        with DatasetWriter(tmp_path / "d", job(n)) as writer:
            assert writer.finished == {0, 1, 2}
        assert read_dataset(tmp_path / "d").info["n"] == expected


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (job(seed=8), r"seed: 7 there, 8 now"),
        (job(motion={"depth_mm": 0.3}), r"scene\.motion\.depth_mm: 0\.1 there, 0\.3 now"),
        (job(render={"max_depth": 2}), r"scene\.render: None there"),
    ],
)
def test_another_job_is_refused_and_named(tmp_path, other, named):
    _write_all(tmp_path / "d")
    before = tree(tmp_path / "d")
    with pytest.raises(InputError, match=named):
        DatasetWriter(tmp_path / "d", other)
    assert tree(tmp_path / "d") == before
    DatasetWriter(tmp_path / "d", job()).close()  # The refused writer holds no lock.


def test_another_variant_is_another_job_other_software_is_recorded(tmp_path):
    from dataclasses import replace

    _write_all(tmp_path / "d")
    with pytest.raises(InputError, match=r"device\.variant: scalar_rgb there, llvm_ad_rgb now"):
        DatasetWriter(tmp_path / "d", replace(job(), device={"device": "cpu", "variant": "llvm_ad_rgb"}))
    for _ in range(2):
        DatasetWriter(tmp_path / "d", replace(job(), software={"synth": "0.2.0"})).close()
    info = read_dataset(tmp_path / "d").info
    assert info["software"] == {"synth": "0.1.0"}
    assert info["continued_with"] == [{"synth": "0.2.0"}]


def test_strange_directories_are_left_alone(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("x")
    with pytest.raises(InputError, match=r"not a dataset.*chapter\.tex"):
        DatasetWriter(tmp_path / "thesis", job())
    assert [file.name for file in (tmp_path / "thesis").iterdir()] == ["chapter.tex"]
    with pytest.raises(InputError, match="is a file"):
        DatasetWriter(tmp_path / "thesis" / "chapter.tex", job())
    (tmp_path / "empty").mkdir()
    DatasetWriter(tmp_path / "empty", job()).close()


HOLD = """
import sys, time
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from samples import job
from synth.dataset.writer import DatasetWriter
writer = DatasetWriter(Path(sys.argv[1]), job())
print("held", flush=True)
time.sleep(60)
"""


def test_second_process_is_told_and_a_killed_one_lets_go(tmp_path):
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    holder = subprocess.Popen([sys.executable, "-c", HOLD, tmp_path / "d", *paths], stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=rf"another process \(pid {holder.pid} on .*\) is writing"):
            DatasetWriter(tmp_path / "d", job())
    finally:
        holder.kill()
        holder.wait()
    DatasetWriter(tmp_path / "d", job()).close()


def _full(*_: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_full_disk_in_a_sample(tmp_path, monkeypatch):
    with DatasetWriter(tmp_path / "d", job()) as writer:
        writer.write(translation_sample(0))
        before = tree(tmp_path / "d")
        with monkeypatch.context() as patch:
            patch.setattr(sample_files, "install_folder", _full)
            with pytest.raises(InputError, match=r"000001: cannot be written: No space left on device"):
                writer.write(translation_sample(1))
        assert tree(tmp_path / "d") == before
        writer.write(translation_sample(1))
    assert read_dataset(tmp_path / "d").samples == [0, 1]


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_full_disk_in_the_manifest(tmp_path, monkeypatch, call):
    """The line is half on the disk when the space ends: it is taken back."""
    with DatasetWriter(tmp_path / "d", job()) as writer:
        writer.write(translation_sample(0))
        entry = write_sample_files(tmp_path / "d", translation_sample(1), job())
        before = tree(tmp_path / "d")
        whole = os.write
        with monkeypatch.context() as patch:
            if call == "write":
                patch.setattr(lines.os, "write", lambda descriptor, line: whole(descriptor, line[:20]))
            else:
                patch.setattr(lines.os, "fsync", _full)
            with pytest.raises(InputError, match=r"manifest\.jsonl: cannot be written: No space left"):
                writer.record(entry)
        assert tree(tmp_path / "d") == before
        assert writer.finished == {0}


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="needs POSIX")
def test_file_size_limit_of_the_system(tmp_path):
    """A real refusal by the kernel (RLIMIT_FSIZE stands in for a full disk), while OpenEXR is writing."""
    code = (
        "import resource, signal, sys; sys.path[:0] = sys.argv[2:]\n"
        "from samples import job, translation_sample\n"
        "from synth.dataset.writer import DatasetWriter\n"
        "from synth.errors import InputError\n"
        "writer = DatasetWriter(sys.argv[1], job())\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))\n"
        "try:\n    writer.write(translation_sample(0))\n"
        "except InputError as error:\n    print(error)\n"
    )
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "d", *paths], capture_output=True, text=True, check=True
    )
    assert "000000: cannot be written" in done.stdout
    assert list((tmp_path / "d" / "samples").iterdir()) == []


def test_read_only_place(tmp_path):
    with pytest.raises(InputError, match=r"/proc/synth.*cannot be written"):
        DatasetWriter("/proc/synth", job())


def test_tampering_is_found(tmp_path):
    _write_all(tmp_path / "d")
    dataset, folder = read_dataset(tmp_path / "d"), tmp_path / "d" / "samples" / "000001"
    data = bytearray((folder / "flow.exr").read_bytes())
    data[-1] ^= 1
    (folder / "flow.exr").write_bytes(bytes(data))
    (folder / "image2.png").unlink()
    problems = dataset.check_hashes(1)
    assert len(problems) == 2
    assert "flow.exr: sha256 is" in problems[0]
    assert "image2.png: cannot be read" in problems[1]
    assert dataset.check_hashes(0) == []


def test_unreadable_datasets_are_named(tmp_path):
    with pytest.raises(InputError, match="no such directory"):
        read_dataset(tmp_path / "none")
    with pytest.raises(InputError, match=r"has no dataset\.json"):
        read_dataset(tmp_path)
    _write_all(tmp_path / "d")
    with pytest.raises(InputError, match=r"no finished sample 7; it has 0 to 2 \(3 of 3\)"):
        read_dataset(tmp_path / "d").read(7)
    for name, damage, message in (
        ("samples/000000/image1.png", lambda data: data[:100], r"000000/image1\.png.*truncated"),
        ("samples/000000/flow.exr", lambda data: data[:-40], r"000000/flow\.exr.*truncated"),
        ("samples/000000/surface.npz", lambda data: data[:-40], r"000000/surface\.npz"),
        ("samples/000000/meta.json", lambda data: data[:-40], r"000000/meta\.json.*not valid JSON"),
    ):
        whole = (tmp_path / "d" / name).read_bytes()
        (tmp_path / "d" / name).write_bytes(damage(whole))
        with pytest.raises(InputError, match=message):
            read_dataset(tmp_path / "d").read(0)
        (tmp_path / "d" / name).write_bytes(whole)
    info = tmp_path / "d" / "dataset.json"
    info.write_text(info.read_text().replace('"schema_version": 1', '"schema_version": 9'))
    with pytest.raises(InputError, match="version 9 of the format"):
        read_dataset(tmp_path / "d")


def test_a_reader_passes_over_a_line_being_written(tmp_path):
    _write_all(tmp_path / "d")
    with (tmp_path / "d" / "manifest.jsonl").open("a") as file:
        file.write('{"index": 3, "tra')
    assert read_dataset(tmp_path / "d").samples == [0, 1, 2]
