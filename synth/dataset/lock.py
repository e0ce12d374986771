"""Who may write into a dataset: one run, or the shards of one job side by side.

POSIX record locks (`fcntl.lockf`) on bytes of DIR/.lock: the kernel drops them when the process ends, however it ends,
and forked children do not inherit them, so that orphaned workers of a killed run hold nothing. They hold between
machines where the file system passes them on (NFS 4, Lustre mounted with flock), and guard against other processes, not
against a second writer in the same one.

    WHOLE    held alone by a plain run, together by all shards that run
    SETUP    held for moments while a shard comes or goes, or a mesh is made that all share
    shard i  held by the process that makes shard i

No storage keeps locks under a URL. There a note stands for one, which its holder renews while it lives (`Lease`); one
that has not been renewed for `EXPIRES_S` is of a process that was killed. Two processes that begin in the same second
may both believe to hold it; as samples depend on (scene, seed, index) alone, they then write the same objects twice,
and no sample is spoilt.
"""

import contextlib
import errno
import fcntl
import json
import os
import socket
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from synth.dataset.atomic_files import storage_errors
from synth.dataset.jsontext import parse_document
from synth.dataset.objects import Objects
from synth.dataset.shard import Shard
from synth.errors import InputError

LOCK_FILE = ".lock"
WHOLE, SETUP, _FIRST_SHARD = 0, 1, 2
_ROOM = 64
"""Bytes of the lock file for each lock: the first is locked, all hold the holder's name."""
RENEWED_S, EXPIRES_S = 20.0, 90.0
"""Seconds from one renewal of a note to the next, and after which a note no longer counts."""
LEASES_FOLDER = "leases"


class DirectoryLock:
    """DIR/.lock, open until `release` or the end of the process."""

    def __init__(self, directory: Path) -> None:
        """Opens the file, where the storage does not refuse (InputError); holds nothing yet."""
        self._directory = directory
        self._path = directory / LOCK_FILE
        with storage_errors(self._path):
            self._descriptor = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
            found = os.fstat(self._descriptor)
            if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1:
                self.release()
                raise OSError(errno.ELOOP, "is a link, a pipe or a device; remove it")

    @contextlib.contextmanager
    def join(self, shard: Shard | None) -> Iterator[bool]:
        """Takes the dataset alone, or a shard beside others; within, no other shard comes or goes.

        Yields whether nobody else is writing, so that the files of all may be put in order. InputError where a plain
        run writes the dataset, or another process this shard, or any where `shard` is None; or the file system offers
        no locks.
        """
        if shard is None:
            if not self._take(WHOLE):
                raise self._held(WHOLE, "is writing this dataset")
            self._sign(WHOLE, _signature())
            yield True
            return
        with self.setup():
            alone = self._take(WHOLE)
            if not alone:
                self._take_shard(shard)  # before anything is touched
            yield alone
            if alone:
                self._take_shard(shard)

    @contextlib.contextmanager
    def leave(self, shard: Shard | None) -> Iterator[bool]:
        """Ends a shard's part in the dataset; within, no other shard comes or goes.

        Yields whether nobody else is writing: always for a plain run, which keeps the dataset until `release`.
        """
        if shard is None:
            yield True
            return
        with self.setup():
            self._let_go(WHOLE)
            alone = self._take(WHOLE)
            yield alone
            if alone:
                self._let_go(WHOLE)

    @contextlib.contextmanager
    def setup(self) -> Iterator[None]:
        """Alone among shards that come or go; waits for others. InputError where the file system offers no locks."""
        self._take(SETUP, fcntl.LOCK_EX)
        try:
            yield
        finally:
            self._let_go(SETUP)

    def release(self) -> None:
        """Lets go of everything; harmless when repeated."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def _take_shard(self, shard: Shard) -> None:
        """One shard, and a part in the dataset; also where WHOLE was held alone before."""
        if not self._take(WHOLE, fcntl.LOCK_SH | fcntl.LOCK_NB):
            raise self._held(WHOLE, "is writing this dataset, without --shard")
        own = _FIRST_SHARD + shard.number
        if not self._take(own):
            raise self._held(own, f"is making shard {shard}")
        self._sign(WHOLE, "shards")
        self._sign(own, _signature())

    def _take(self, place: int, how: int = fcntl.LOCK_EX | fcntl.LOCK_NB) -> bool:
        try:
            fcntl.lockf(self._descriptor, how, 1, place * _ROOM)
        except OSError as error:
            if error.errno in (errno.EACCES, errno.EAGAIN):
                return False
            raise InputError(
                f"{self._path}: this file system offers no locks ({error.strerror}); give an --out on another"
            ) from error
        return True

    def _let_go(self, place: int) -> None:
        fcntl.lockf(self._descriptor, fcntl.LOCK_UN, 1, place * _ROOM)

    def _sign(self, place: int, text: str) -> None:
        with contextlib.suppress(OSError):  # It only serves messages; a full disk must not matter here.
            os.pwrite(self._descriptor, f"{text}\n".encode("ascii", "replace")[:_ROOM].ljust(_ROOM), place * _ROOM)

    def _held(self, place: int, does: str) -> InputError:
        holder = os.pread(self._descriptor, _ROOM, place * _ROOM).decode("ascii", "replace").strip(" \n\0")
        named = f" ({holder})" if holder else ""
        return InputError(
            f"{self._directory}: another process{named} {does}; wait for it to end, or give another --out"
        )


class Lease:
    """A `DirectoryLock` made of notes under a URL: held from `join` until `release` or the end of the process.

    Nobody knows to be the last here, so that shards leave it to a plain run to put the dataset together.
    """

    def __init__(self, objects: Objects) -> None:
        self._objects = objects
        self._name = ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._renew_until_released, daemon=True)

    @contextlib.contextmanager
    def join(self, shard: Shard | None) -> Iterator[bool]:
        """Takes the place of a plain run, or of one shard; yields whether it is a plain run's.

        InputError where another process writes there, or the storage refuses.
        """
        own = f"{shard.name if shard else 'whole'}.json"
        for name in self._objects.names(LEASES_FOLDER):
            # A plain run tolerates nobody; a shard tolerates other shards of the same job.
            if shard is None or name in (own, "whole.json"):
                self._refuse_if_alive(f"{LEASES_FOLDER}/{name}")
        self._name = f"{LEASES_FOLDER}/{own}"
        self._renew()
        self._thread.start()
        yield shard is None

    @contextlib.contextmanager
    def leave(self, shard: Shard | None) -> Iterator[bool]:
        """Yields whether this is a plain run."""
        yield shard is None

    @contextlib.contextmanager
    def setup(self) -> Iterator[None]:
        """Nothing is held: whatever is made within may be made twice."""
        yield

    def release(self) -> None:
        """Lets others write; harmless when repeated, and where nothing was taken."""
        if self._ended.is_set() or self._thread.ident is None:
            return
        self._ended.set()
        self._thread.join()
        self._objects.delete([self._name])

    def _refuse_if_alive(self, name: str) -> None:
        content = self._objects.read(name)
        try:
            note = parse_document(content or b"{}", name)
            age, host, pid = time.time() - float(note["time"]), str(note["host"]), int(note["pid"])
        except (ValueError, KeyError, TypeError, OverflowError):
            return
        # A note from the future, beyond what clocks may differ by, says nothing of a living process.
        if not abs(age) <= EXPIRES_S or (host == socket.gethostname() and not Path(f"/proc/{pid}").exists()):
            return
        raise InputError(
            f"{self._objects.out}: another process (pid {pid} on {host}) is writing this dataset, last heard of "
            f"{age:.0f} s ago; wait for it to end (if it was killed, {EXPIRES_S:.0f} s), or give another --out"
        )

    def _renew(self) -> None:
        note = {"pid": os.getpid(), "host": socket.gethostname(), "time": time.time()}
        self._objects.write(self._name, json.dumps(note).encode())

    def _renew_until_released(self) -> None:
        while not self._ended.wait(RENEWED_S):
            with contextlib.suppress(InputError):  # the samples' own writing meets the same trouble and says so
                self._renew()


def _signature() -> str:
    return f"pid {os.getpid()} on {socket.gethostname()}"
