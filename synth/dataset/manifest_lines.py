"""How a line of the manifest or of the failures is recorded while a dataset is being written.

    DIR/manifest.jsonl, failures.jsonl   of a run in a directory: each line is appended, and flushed to the disk
    DIR/shards/i-of-N/                   the same files of a shard that runs, or that was stopped
    URL/journal/                         the lines of any run under a URL, each in an object of its own, as nothing can
                                         be appended

A run that ends merges all lines into manifest and failures, sorted, so that they do not depend on the number of workers
or on interruptions; only `seconds` does. In a directory shards do so, too: whichever is alone, the first to come or the
last to leave. Under a URL none knows to be the last, and a plain run does it.
"""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from synth.dataset.atomic_files import remove_partials, storage_errors
from synth.dataset.jsontext import parse_document, to_line
from synth.dataset.manifest import (
    FAILURES_FILE,
    MANIFEST_FILE,
    append_line,
    failure_key,
    manifest_key,
    merge_lines,
    scan_lines,
)
from synth.dataset.objects import Objects
from synth.dataset.shard import Shard
from synth.errors import InputError

SHARDS_FOLDER = "shards"
JOURNAL_FOLDER = "journal"

Known = tuple[set[int], set[tuple[int, int]]]
"""Indices of finished samples; index and attempt of failures."""


class Lines:
    """The lines of a dataset in a directory. `folder` holds manifest and failures of all, sorted after `merge`."""

    def __init__(self, folder: Path, samples: str, holds: Callable[[int], bool]) -> None:
        """A line counts where `holds` says that its sample's files are there; these are in the folder `samples`."""
        self.folder, self._own, self._holds = folder, folder, holds
        self._samples = folder / samples

    def begin(self, shard: Shard | None, per_trajectory: int, alone: bool) -> Known:
        """What is on record; of a shard only the samples that it makes, that many of a trajectory.

        Nobody else is writing where it is `alone`; then what interrupted runs left is put right.
        """
        if shard is None:
            return self.merge()
        if alone:
            self.merge()
        return self._begin_shard(shard, lambda index: shard.makes(index // per_trajectory))

    def add(self, file: str, name: str, record: Mapping[str, Any]) -> None:
        """Adds a line to this process's manifest or failures; `name` is that of the line."""
        append_line(self._own / file, record)

    def merge(self) -> Known:
        """Puts right what interrupted runs left, takes in what shards made; nobody else may be writing `folder`.

        The lines of shards are merged before their folder is removed: a stop in between leaves lines twice, which count
        once.
        """
        with storage_errors(self.folder):
            self._samples.mkdir(exist_ok=True)
            remove_partials(self.folder)
            remove_partials(self._samples)
        shards = self.folder / SHARDS_FOLDER
        homes = sorted(shards.glob("*-of-*"))
        others = [home / MANIFEST_FILE for home in homes]
        finished = merge_lines(self.folder / MANIFEST_FILE, manifest_key, others, self._holds)
        failed = merge_lines(self.folder / FAILURES_FILE, failure_key, [home / FAILURES_FILE for home in homes])
        if shards.is_dir():
            with storage_errors(shards):
                shutil.rmtree(shards)
        return finished, failed

    def publish(self) -> None:
        """Gives the dataset the merged files: here they are its own."""

    def _begin_shard(self, shard: Shard, makes: Callable[[int], bool]) -> Known:
        """Makes DIR/shards/i-of-N/, or puts right what this shard's killed process left in it."""
        folder = self.folder / SHARDS_FOLDER
        self._own = folder / shard.name
        with storage_errors(self._own):
            self._samples.mkdir(exist_ok=True)
            others = [home.name for home in folder.iterdir()] if folder.is_dir() else []
            strange = [name for name in others if not name.endswith(f"-of-{shard.count}")]
            if strange:
                raise InputError(
                    f"{self.folder}: is being made in another number of shards ({strange[0]}); wait for these to end"
                )
            self._own.mkdir(parents=True, exist_ok=True)
            remove_partials(self._own)
            remove_partials(self._samples, lambda name: name.isdecimal() and makes(int(name)))
        recorded = merge_lines(self._own / MANIFEST_FILE, manifest_key)
        recorded |= scan_lines(self.folder / MANIFEST_FILE, manifest_key).places.keys()
        failed = merge_lines(self._own / FAILURES_FILE, failure_key)
        failed |= scan_lines(self.folder / FAILURES_FILE, failure_key).places.keys()
        return {index for index in recorded if makes(index) and self._holds(index)}, failed


class JournalLines(Lines):
    """The lines of a dataset under a URL: `folder` is a copy on this machine, what counts are the journal's objects."""

    def __init__(self, folder: Path, samples: str, objects: Objects) -> None:
        # A line was recorded after the sample's objects were put; to ask for each again would take long.
        super().__init__(folder, samples, lambda index: True)
        self._objects = objects

    def begin(self, shard: Shard | None, per_trajectory: int, alone: bool) -> Known:
        """See `Lines.begin`; of a shard, too, all that is on record."""
        for name in (MANIFEST_FILE, FAILURES_FILE):
            self._objects.get(name, self.folder / name)
        for name in self._objects.names(JOURNAL_FOLDER):
            if content := self._objects.read(f"{JOURNAL_FOLDER}/{name}"):
                line = parse_document(content, name)
                append_line(self.folder / (FAILURES_FILE if "draw" in line else MANIFEST_FILE), line)
        return self.merge()

    def add(self, file: str, name: str, record: Mapping[str, Any]) -> None:
        self._objects.write(f"{JOURNAL_FOLDER}/{name}.json", to_line(record).encode("utf-8"))
        super().add(file, name, record)

    def publish(self) -> None:
        """Puts the merged files under the URL, which then need the journal no longer."""
        for name in (MANIFEST_FILE, FAILURES_FILE):
            self._objects.put(self.folder / name, name)
        self._objects.delete(f"{JOURNAL_FOLDER}/{name}" for name in self._objects.names(JOURNAL_FOLDER))
