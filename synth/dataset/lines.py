"""Files of one JSON object a line that survive a killed writer: manifest.jsonl and failures.jsonl.

A line counts when it is ended by a newline and parses. Appending is one write, flushed to the disk; a run that was
killed in between leaves at most one torn line, the last, which a writer cuts off and a reader passes over.
"""

import errno
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

from synth.dataset.jsontext import to_line
from synth.dataset.storage import replacing, storage_errors
from synth.errors import InputError

Key = TypeVar("Key", bound=Any)
"""Hashable, and ordered."""


@dataclass(frozen=True)
class LineTable(Generic[Key]):
    """Where the lines of a file are.

    Attributes:
        places: key -> (offset, length) in bytes, of the last line with that key; in the file's order of first keys.
        tidy: the file holds the intact lines in the order of their keys, each once, and nothing else.
    """

    places: dict[Key, tuple[int, int]]
    tidy: bool


def scan_lines(path: Path, key: Callable[[dict[str, Any]], Key]) -> LineTable[Key]:
    """Reads through a file.

    Args:
        path: the file; missing is as empty.
        key: of a line's object; KeyError, TypeError, ValueError or IndexError where it is not a line of this file.

    Raises:
        InputError: The file cannot be read, or a line other than the last is damaged.
    """
    places: dict[Key, tuple[int, int]] = {}
    end, torn, tidy, previous = 0, False, True, None
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file):
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
    except (ValueError, KeyError, TypeError, IndexError):
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

    Args:
        path: the file; made where it is missing.
        key: as of `scan_lines`; of several lines with one key the last counts.
        others: more lines; files that are missing are as empty.
        keep: false for the keys whose lines to leave out.

    Returns:
        The keys of the file's lines.

    Raises:
        InputError: A file is damaged, or the storage refuses; the file is as before.
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
