"""Writing so that a file or folder appears whole or not at all, also when the machine stops in the middle.

New content goes to a neighbour with a hidden name, is flushed to the disk (fsync), and takes its place by one rename;
the folder is then flushed, too, because a rename lives in the folder.

Files of the same name that an earlier run wrote are replaced; those of somebody else are not (`refuse_foreign`).
"""

import contextlib
import errno
import os
import shutil
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from synth.errors import InputError

PARTIAL = ".partial-"
"""Part of the hidden name of anything unfinished: `.NAME.partial-PID-TOKEN`."""

HEAD = 4096
"""Bytes at the beginning of a file among which its mark stands."""

_OLD = ".old"

_TOKEN = uuid.uuid4().hex[:8]
"""Processes on several machines may have the same number."""


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turns an OSError (disk full, no permission, device gone) into an InputError that names `path`."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"{path}: cannot be written: {reason}; what was finished before is safe, "
            "put this right and give the same command again to go on"
        ) from error


def partial_name(path: Path) -> Path:
    """The neighbour of `path` in which this process prepares its content."""
    return path.with_name(f".{path.name}{PARTIAL}{os.getpid()}-{_TOKEN}")


def remove_partials(directory: Path, of: Callable[[str], bool] = lambda name: True) -> None:
    """Removes what killed processes left unfinished in a folder; only of names for which `of` is true."""
    for entry in directory.glob(f".*{PARTIAL}*"):
        if not of(entry.name[1:].partition(PARTIAL)[0].removesuffix(_OLD)):
            continue
        if entry.is_dir():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file for the new content of `path`, which takes its place when all is written and flushed.

    InputError where the storage refuses; the old content is still there, as after any other error.
    """
    partial = partial_name(path)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with partial.open("wb") as file:
                yield file
            flush(partial)
            os.replace(partial, path)
            flush(path.parent)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def replace_file(path: Path, content: bytes) -> None:
    """Gives a file new content as a whole; where the storage refuses (InputError) the old content is still there."""
    with replacing(path) as file:
        file.write(content)


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
                f"{other}: exists and does not come from this command; move it away, or give another place"
            )


def install_folder(partial: Path, final: Path) -> None:
    """Renames a finished folder into place and flushes it; an older folder of that name gives way.

    Two processes may install the same name at once (a task that was given up for lost, and its repetition): the last
    one stays.
    """
    for entry in partial.rglob("*"):  # files and folders
        flush(entry)
    flush(partial)
    while True:
        try:
            os.rename(partial, final)
            break
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
        old = partial_name(final.with_name(f"{final.name}{_OLD}"))
        with contextlib.suppress(FileNotFoundError):  # the other process was faster
            os.rename(final, old)
        shutil.rmtree(old, ignore_errors=True)
    flush(final.parent)
