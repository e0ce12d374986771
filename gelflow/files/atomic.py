"""Writing a file as a whole or not at all: into a temporary file beside it, which is then renamed.

Files of the same name that an earlier run wrote are replaced; those of somebody else are not (`refuse_foreign`).
"""

import csv
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gelflow.errors import InputError

HEAD = 4096
"""Bytes at the beginning of a file among which its mark stands."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path with the same suffix in the same folder; renames it to `path` if the block succeeds.

    Folders that are missing are made. If the block fails, the temporary file is removed and what was at `path` stays.
    OSError where the folder cannot be written to or the disk is full; its `filename` says which file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None and error.filename is None:  # a write to an open file does not know its name
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes UTF-8 text to `path`, as a whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Writes a table as CSV in UTF-8, as a whole or not at all."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])


def refuse_foreign(path: Path, mark: bytes, *beside: Path) -> None:
    """Sees that files which are about to be replaced come from an earlier run; InputError where one does not.

    A file of ours has `mark` near its beginning; those `beside` it, without a mark, are ours where it is there.
    """
    if path.is_file():
        with path.open("rb") as file:
            beside = () if mark in file.read(HEAD) else (path,)
    for other in beside:
        if other.exists():
            raise InputError(
                f"{other}: exists and does not come from this command; move it away, or give another --out"
            )
