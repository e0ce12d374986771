"""Writing so that a file or folder appears whole or not at all, also when the machine stops in the middle.

New content goes to a neighbour with a hidden name, is flushed to the disk (fsync), and takes its place by one rename;
the folder is then flushed, too, because a rename lives in the folder.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from synth.errors import InputError

PARTIAL = ".partial-"
"""In the hidden name of anything unfinished: `.NAME.partial-PID`."""


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
    """Where this process prepares the content of `path`."""
    return path.with_name(f".{path.name}{PARTIAL}{os.getpid()}")


def remove_partials(directory: Path) -> None:
    """Removes what killed processes left unfinished in a folder."""
    for entry in directory.glob(f".*{PARTIAL}*"):
        if entry.is_dir():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def flush(path: Path) -> None:
    """Fsync of a file or a folder."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_file(path: Path, content: bytes) -> None:
    """Gives a file new content as a whole.

    Raises:
        InputError: The storage refuses; the old content is still there.
    """
    partial = partial_name(path)
    with storage_errors(path):
        try:
            partial.write_bytes(content)
            flush(partial)
            os.replace(partial, path)
            flush(path.parent)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def install_folder(partial: Path, final: Path) -> None:
    """Renames a finished folder into place and flushes it; an older folder of that name gives way.

    Raises:
        OSError: The storage refuses.
    """
    for entry in partial.rglob("*"):  # files and folders
        flush(entry)
    flush(partial)
    if final.exists():
        old = final.with_name(f".{final.name}.old{PARTIAL}{os.getpid()}")
        os.rename(final, old)
        os.rename(partial, final)
        shutil.rmtree(old)
    else:
        os.rename(partial, final)
    flush(final.parent)
