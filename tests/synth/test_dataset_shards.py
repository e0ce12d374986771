"""Shards of one job side by side in one directory: the dataset of one go, whoever comes, leaves or is killed."""

import json
from collections.abc import Iterable
from pathlib import Path

import pytest
from samples import job, translation_sample, tree, writing_elsewhere

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
        _make(writer, range(N))
    return _comparable(directory)


def _make(writer: DatasetWriter, indices: Iterable[int]) -> None:
    for index in indices:
        writer.write(translation_sample(index))
        if index == 4:
            writer.fail(4, 0, "simulate", "Newton failed")


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
        writer.fail(4, 0, "simulate", "Newton failed")
    assert _comparable(tmp_path / "d") == expected


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
    assert _comparable(tmp_path / "d") == expected


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
            with pytest.raises(InputError, match=message):
                DatasetWriter(directory, asked, shard, PAIRS)
        assert tree(directory) == before
        DatasetWriter(directory, job(N), Shard(1, 2), PAIRS).close()
    DatasetWriter(directory, job(N), Shard(1, 3), PAIRS).close()  # once the others have ended


def test_wrong_shards_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("", "1", "2/2", "-1/2", "0/0", "1/x", "0.5/2", "a0/2"):
        with pytest.raises(InputError, match=r"--shard .*: give i/N with 0 <= i < N"):
            Shard.parse(text)
    assert main(["generate", "--out", str(tmp_path / "d"), "--shard", "2/2"]) == 2
    assert "--shard 2/2: give i/N with 0 <= i < N, such as 0/16; the last of 2 is 1/2" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_shards_cover_each_trajectory_once() -> None:
    for count in (1, 2, 3, 7):
        for trajectory in range(20):
            assert sum(Shard(number, count).makes(trajectory) for number in range(count)) == 1
