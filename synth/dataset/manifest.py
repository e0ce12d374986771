"""Files of one JSON object a line that survive a killed writer: manifest.jsonl and failures.jsonl.

A line counts when it is ended by a newline and parses. Appending is one write, flushed to the disk; a run that was
killed in between leaves at most one torn line, the last, which a writer cuts off and a reader passes over. The entries
of manifest.jsonl, one for each finished sample, are made by `synth.dataset.sample_files`.
"""

import errno
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

from synth.dataset.atomic_files import replacing, storage_errors
from synth.dataset.jsontext import to_line
from synth.errors import InputError
from synth.untrusted import open_file

MANIFEST_FILE = "manifest.jsonl"
FAILURES_FILE = "failures.jsonl"
_LONGEST_LINE = 2**24
"""Bytes; a longer line is damaged."""


@dataclass(frozen=True)
class ManifestEntry:
    """A line of manifest.jsonl.

    `sha256` is by file name, "left/flow.exr" for a further camera's; `max_flow_px` is the main camera's, None where no
    pixel of it sees the gel.
    """

    index: int
    trajectory: int
    frames: tuple[int, ...]
    seed: int
    sha256: Mapping[str, str]
    seconds: Mapping[str, float]
    diagnostics: Mapping[str, Any]
    force_n: tuple[tuple[float, ...], ...]
    torque_nmm: tuple[tuple[float, ...], ...]
    max_flow_px: float | None

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> "ManifestEntry":
        """The entry of a line's JSON object; KeyError or TypeError where that is not a sample's."""
        values = {name: record[name] for name in cls.__dataclass_fields__}
        for name, kind in (("sha256", str), ("seconds", int | float)):
            if not (isinstance(values[name], dict) and all(isinstance(value, kind) for value in values[name].values())):
                raise TypeError(name)
        rows = {name: tuple(map(tuple, record[name])) for name in ("force_n", "torque_nmm")}
        return cls(**{**values, **rows, "index": int(record["index"]), "frames": tuple(record["frames"])})


@dataclass(frozen=True)
class Failure:
    """A line of failures.jsonl: a random instance that gave no trajectory.

    The index is that of the trajectory's first sample, `draw` 0 for its first failure, and so on; the stage is
    "sensor", "draw" or "simulate"; the reason is for the user, the last good state a simulation's.
    """

    index: int
    draw: int
    stage: str
    reason: str
    last_good_state: dict[str, Any] | None = None


def manifest_key(record: dict[str, Any]) -> int:
    """Index of a line of the manifest; KeyError or TypeError where it is not one."""
    return ManifestEntry.from_record(record).index


def failure_key(record: dict[str, Any]) -> tuple[int, int]:
    """Index and number of a line of the failures; KeyError or TypeError where it is not one."""
    return int(record["index"]), int(record["draw"])


Key = TypeVar("Key", bound=Any)
"""Hashable, and ordered."""


@dataclass(frozen=True)
class LineTable(Generic[Key]):
    """Places of a file's lines: (offset, length) in bytes of each key's last line, in the order of first lines.

    A tidy file holds the intact lines in the order of their keys, each once, and nothing else.
    """

    places: dict[Key, tuple[int, int]]
    tidy: bool


def scan_lines(path: Path, key: Callable[[dict[str, Any]], Key]) -> LineTable[Key]:
    """Reads through a file; a missing one is as empty. InputError where a line other than the last is damaged.

    The key is of a line's object; KeyError, TypeError, ValueError or IndexError where it is not a line of this file.
    """
    places: dict[Key, tuple[int, int]] = {}
    end, torn, tidy, previous = 0, False, True, None
    try:
        with open_file(path) as file:
            for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), b"")):
                if torn:
                    raise InputError(
                        f"{path}: line {number} is damaged; delete that line "
                        "(what it stood for is then made again) and try again"
                    )
                found = _key_of(line, key)
                torn = found is None
                if torn:
                    continue
                tidy = tidy and (previous is None or previous < found)
                previous = found
                places[found] = (end, len(line))
                end += len(line)
    except FileNotFoundError:
        return LineTable({}, True)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    return LineTable(places, tidy and not torn)


def _key_of(line: bytes, key: Callable[[dict[str, Any]], Key]) -> Any:
    """The key of an intact line, else None."""
    if not line.endswith(b"\n"):
        return None
    try:
        return key(json.loads(line))
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError):
        return None


def read_line(path: Path, place: tuple[int, int]) -> dict[str, Any]:
    """The object in one line; InputError where the file cannot be read or has changed since it was scanned."""
    offset, length = place
    try:
        with path.open("rb") as file:
            file.seek(offset)
            record = json.loads(file.read(length))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path}: the line at byte {offset} is damaged, or was rewritten since; try again") from error
    return dict(record)


def append_line(path: Path, record: object) -> None:
    """Adds a line in one write and flushes it; when the storage refuses (InputError), the file is as before."""
    line = to_line(record).encode("utf-8")
    with storage_errors(path):
        descriptor = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            before = os.fstat(descriptor).st_size
            try:
                if os.write(descriptor, line) != len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(descriptor)
            except OSError:
                os.ftruncate(descriptor, before)
                raise
        finally:
            os.close(descriptor)


def merge_lines(
    path: Path,
    key: Callable[[dict[str, Any]], Key],
    others: Sequence[Path] = (),
    keep: Callable[[Key], bool] = lambda key: True,
) -> set[Key]:
    """Gives a file its own intact lines and those of other files, in the order of their keys; whole or not at all.

    Missing files are as empty. `key` is as for `scan_lines`; of several lines with one key the last counts, and lines
    are left out for whose key `keep` is false. Returns the keys of the file's lines. InputError where a file is
    damaged, or the storage refuses; the file is then as before.
    """
    tables = {source: scan_lines(source, key) for source in (path, *others)}
    every = {found: (source, place) for source, table in tables.items() for found, place in table.places.items()}
    places = {found: where for found, where in every.items() if keep(found)}
    if others or not tables[path].tidy or len(places) < len(every) or not path.exists():
        with replacing(path) as merged:
            for _, lines in groupby((places[found] for found in sorted(places)), key=lambda where: where[0]):
                _copy(list(lines), merged)
    return set(places)


def _copy(lines: Sequence[tuple[Path, tuple[int, int]]], target: BinaryIO) -> None:
    with lines[0][0].open("rb") as file:
        for _, (offset, length) in lines:
            file.seek(offset)
            target.write(file.read(length))
