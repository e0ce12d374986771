"""Who may write under a URL, where no storage keeps locks: a note that its holder renews while it lives.

A note that has not been renewed for `EXPIRES_S` is of a process that was killed. Two processes that begin in the same
second may both believe to hold it; as samples depend on (scene, seed, index) alone, they then write the same objects
twice, and no sample is spoilt.
"""

import json
import os
import socket
import threading
import time

from synth.dataset.shard import Shard
from synth.dataset.url_store import UrlStore
from synth.errors import InputError

RENEWED_S, EXPIRES_S = 20.0, 90.0
_FOLDER = "leases"


class Lease:
    """Held from creation until `release` or, for others to see, some time after the process was killed."""

    def __init__(self, store: UrlStore, shard: Shard | None) -> None:
        """Takes the place of a plain run, or of one shard.

        Raises:
            InputError: another process writes there, or the storage refuses.
        """
        self._store = store
        self._name = f"{_FOLDER}/{shard.name if shard else 'whole'}.json"
        for name in store.names(_FOLDER):
            # A plain run tolerates nobody; a shard tolerates other shards of the same job.
            if shard is None or name in (f"{shard.name}.json", "whole.json"):
                self._refuse_if_alive(f"{_FOLDER}/{name}")
        self._ended = threading.Event()
        self._renew()
        self._thread = threading.Thread(target=self._keep, daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Lets others write; harmless when repeated."""
        if self._ended.is_set():
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
            f"{self._store.url}: another process (pid {pid} on {host}) is writing this dataset, last heard of "
            f"{age:.0f} s ago; wait for it to end (if it was killed, {EXPIRES_S:.0f} s), or give another --out"
        )

    def _renew(self) -> None:
        note = {"pid": os.getpid(), "host": socket.gethostname(), "time": time.time()}
        self._store.write(self._name, json.dumps(note).encode())

    def _keep(self) -> None:
        while not self._ended.wait(RENEWED_S):
            try:
                self._renew()
            except InputError:
                continue  # the samples' own writing meets the same trouble and says so


def _runs(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
