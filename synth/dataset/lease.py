"""Who may write under a URL, where no storage keeps locks: a note that its holder renews while it lives.

A note that has not been renewed for `EXPIRES_S` is of a process that was killed. Two processes that begin in the same
second may both believe to hold it; as samples depend on (scene, seed, index) alone, they then write the same objects
twice, and no sample is spoilt.
"""

import contextlib
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from synth.dataset.shard import Shard
from synth.dataset.store import Store
from synth.errors import InputError

RENEWED_S, EXPIRES_S = 20.0, 90.0
LEASES_FOLDER = "leases"


class Lease:
    """As `synth.dataset.lock.DirectoryLock`: held from `join` until `release` or the end of the process.

    Nobody knows to be the last here, so that shards leave it to a plain run to put the dataset together.
    """

    def __init__(self, store: Store) -> None:
        self._store, self._name = store, ""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._renew_until_released, daemon=True)

    @contextlib.contextmanager
    def join(self, shard: Shard | None) -> Iterator[bool]:
        """Takes the place of a plain run, or of one shard; yields whether it is a plain run's.

        Raises:
            InputError: another process writes there, or the storage refuses.
        """
        own = f"{shard.name if shard else 'whole'}.json"
        for name in self._store.names(LEASES_FOLDER):
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
        self._store.delete([self._name])

    def _refuse_if_alive(self, name: str) -> None:
        content = self._store.read(name)
        try:
            note = json.loads(content or b"{}")
            age, host, pid = time.time() - note["time"], note["host"], note["pid"]
        except (ValueError, KeyError):
            return
        if age > EXPIRES_S or (host == socket.gethostname() and not _runs(pid)):
            return
        raise InputError(
            f"{self._store.out}: another process (pid {pid} on {host}) is writing this dataset, last heard of "
            f"{age:.0f} s ago; wait for it to end (if it was killed, {EXPIRES_S:.0f} s), or give another --out"
        )

    def _renew(self) -> None:
        note = {"pid": os.getpid(), "host": socket.gethostname(), "time": time.time()}
        self._store.write(self._name, json.dumps(note).encode())

    def _renew_until_released(self) -> None:
        while not self._ended.wait(RENEWED_S):
            try:
                self._renew()
            except InputError:
                continue  # the samples' own writing meets the same trouble and says so


def _runs(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()
