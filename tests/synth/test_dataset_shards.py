"""Shards of one job side by side in one directory: the dataset of one go, whoever comes, leaves or is killed."""

import contextlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from samples import job, translation_sample, tree

from synth.cli import main
from synth.dataset.reader import read_dataset
from synth.dataset.shard import Shard
from synth.dataset.writer import DatasetWriter
from synth.errors import InputError

PAIRS = 2
"""Samples 0 1 | 2 3 | 4 5: with two shards, 0 and 1 and 4 and 5 are of shard 0/2, 2 and 3 of shard 1/2."""
N = 6


def _comparable(directory: Path) -> dict[str, object]:
    files = {name: data for name, data in tree(directory).items() if name != "summary.json"}
    lines = [json.loads(line) for line in files["manifest.jsonl"].splitlines()]
    return {**files, "manifest.jsonl": [{**line, "seconds": None} for line in lines]}


def _in_one_go(directory: Path) -> dict[str, object]:
    with DatasetWriter(directory, job(N)) as writer:
        for index in range(N):
            writer.write(translation_sample(index))
        writer.fail(4, 0, "simulate", "Newton failed")
    return _comparable(directory)


def _make(writer: DatasetWriter, indices: list[int]) -> None:
    for index in indices:
        writer.write(translation_sample(index))
        if index == 4:
            writer.fail(4, 0, "simulate", "Newton failed")


HOLD = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[4:]
from samples import job, translation_sample
from synth.dataset.shard import Shard
from synth.dataset.writer import DatasetWriter
shard = Shard.parse(sys.argv[2])
with DatasetWriter(Path(sys.argv[1]), job(6), shard, 2) as writer:
    for index in sys.argv[3].split():
        writer.write(translation_sample(int(index)))
    print("held", flush=True)
    sys.stdin.readline()
"""


@contextlib.contextmanager
def _elsewhere(directory: Path, shard: str, indices: str) -> Iterator["subprocess.Popen[str]"]:
    """Another process that has made samples of a shard and goes on to hold it until it reads a line or is killed."""
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    command = [sys.executable, "-c", HOLD, str(directory), shard, indices, *paths]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def test_one_after_the_other(tmp_path: Path) -> None:
    expected = _in_one_go(tmp_path / "one")
    for shard, own in (("1/2", [2, 3]), ("0/2", [0, 1, 4, 5])):
        with DatasetWriter(tmp_path / "d", job(N), Shard.parse(shard), PAIRS) as writer:
            assert writer.finished == set()
            _make(writer, own)
        assert not (tmp_path / "d" / "shards").exists()  # a whole dataset at any time that nobody writes
    assert _comparable(tmp_path / "d") == expected
    with DatasetWriter(tmp_path / "d", job(N), Shard(0, 2), PAIRS) as writer:
        assert writer.finished == {0, 1, 4, 5}


def test_the_last_to_leave_joins(tmp_path: Path) -> None:
    expected = _in_one_go(tmp_path / "one")
    with _elsewhere(tmp_path / "d", "0/2", "0 1 4") as other:
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
        writer.fail(4, 0, "simulate", "Newton failed")
    assert _comparable(tmp_path / "d") == expected


def test_a_killed_shard_is_taken_in_by_whoever_is_next(tmp_path: Path) -> None:
    """Its lines, also when the last one is torn; a stop in the middle of joining counts no line twice."""
    expected = _in_one_go(tmp_path / "one")
    with _elsewhere(tmp_path / "d", "0/2", "0 1"):
        pass
    home = tmp_path / "d" / "shards" / "0-of-2"
    lines = (home / "manifest.jsonl").read_bytes()
    (tmp_path / "d" / "manifest.jsonl").write_bytes(lines)  # as a joining that was killed before it removed the folder
    with (home / "manifest.jsonl").open("a") as file:
        file.write('{"index": 4, "tra')
    with DatasetWriter(tmp_path / "d", job(N)) as writer:
        assert writer.finished == {0, 1}
        _make(writer, [2, 3, 4, 5])
    assert _comparable(tmp_path / "d") == expected


def test_who_is_refused_beside_a_shard(tmp_path: Path) -> None:
    directory = tmp_path / "d"
    with _elsewhere(directory, "0/2", "0") as other:
        before = tree(directory)
        with pytest.raises(InputError, match=r"another process \(shards\) is writing this dataset"):
            DatasetWriter(directory, job(N))
        with pytest.raises(InputError, match=rf"another process \(pid {other.pid} on .*\) is making shard 0/2"):
            DatasetWriter(directory, job(N), Shard(0, 2), PAIRS)
        with pytest.raises(InputError, match=r"is being made in another number of shards \(0-of-2\)"):
            DatasetWriter(directory, job(N), Shard(1, 3), PAIRS)
        with pytest.raises(InputError, match="seed: 7 there, 8 now"):
            DatasetWriter(directory, job(N, seed=8), Shard(1, 2), PAIRS)
        assert tree(directory) == before
        DatasetWriter(directory, job(N), Shard(1, 2), PAIRS).close()
    DatasetWriter(directory, job(N), Shard(1, 3), PAIRS).close()  # once the others have ended


def test_a_wrong_shard_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["generate", "--out", str(tmp_path / "d"), "--shard", "2/2"]) == 2
    assert "--shard 2/2: give i/N with 0 <= i < N, such as 0/16; the last of 2 is 1/2" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["", "1", "2/2", "-1/2", "0/0", "1/x", "0.5/2", "a0/2"])
def test_wrong_shards(text: str) -> None:
    with pytest.raises(InputError, match=r"--shard .*: give i/N with 0 <= i < N"):
        Shard.parse(text)


def test_shards_cover_each_trajectory_once() -> None:
    for count in (1, 2, 3, 7):
        for trajectory in range(20):
            assert sum(Shard(number, count).makes(trajectory) for number in range(count)) == 1
