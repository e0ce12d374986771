"""One process at a time writes into a dataset.

A POSIX record lock (`fcntl.lockf`) on DIR/.lock: the kernel drops it when the process ends, however it ends, and forked
children do not inherit it, so that orphaned workers of a killed run hold nothing. It guards against other processes,
not against a second writer in the same one.
"""

import contextlib
import errno
import fcntl
import os
from pathlib import Path

from synth.dataset.storage import storage_errors
from synth.errors import InputError

LOCK_FILE = ".lock"


class DirectoryLock:
    """Holds DIR/.lock from creation until `release` or the end of the process."""

    def __init__(self, directory: Path) -> None:
        """Takes the lock.

        Raises:
            InputError: Another process holds it, or the file system offers no locks.
        """
        path = directory / LOCK_FILE
        with storage_errors(path):
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.lockf(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.pread(self._descriptor, 32, 0).decode("ascii", "replace").strip()
            os.close(self._descriptor)
            self._descriptor = -1
            if error.errno in (errno.EACCES, errno.EAGAIN):
                raise InputError(
                    f"{directory}: another process{f' ({holder})' if holder else ''} is writing this dataset; "
                    "wait for it to end, or give another --out"
                ) from error
            raise InputError(
                f"{path}: this file system offers no locks ({error.strerror}); give an --out on another"
            ) from error
        with contextlib.suppress(
            OSError
        ):  # The number only serves the message above; a full disk must not matter here.
            os.ftruncate(self._descriptor, 0)
            os.pwrite(self._descriptor, f"pid {os.getpid()}\n".encode("ascii"), 0)

    def release(self) -> None:
        """Lets go of the lock; harmless when repeated."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
