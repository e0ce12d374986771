"""A dataset under a URL while it is being written: the same files as in a directory, without renaming or appending.

A sample counts when its line is in manifest.jsonl or, until the run ends, in an object of its own, journal/NNNNNN.json,
which is put after the sample's files. A run that ends puts the manifest together and removes the journal; one that was
killed leaves it to the next. Shards leave it to a plain run: without locks none of them knows to be the last.

Samples are made in a folder of this machine's temporary space and copied whole; nothing of the dataset is kept there.
"""

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from synth.dataset.finalising import Finalising
from synth.dataset.job import DATASET_FILE, Job, check_record, continued, refuse_another_job
from synth.dataset.joining import FAILURES_FILE, MANIFEST_FILE, failure_key, manifest_key
from synth.dataset.jsontext import to_document, to_line
from synth.dataset.lease import Lease
from synth.dataset.lines import append_line, rewrite_lines, scan_lines
from synth.dataset.sample import SAMPLES_FOLDER, ManifestEntry, Sample, sample_name
from synth.dataset.sample_files import write_sample_files
from synth.dataset.shard import Shard
from synth.dataset.summary import SUMMARY_FILE, summary_document
from synth.dataset.url_store import UrlStore
from synth.dataset.writer import MESHES_FOLDER
from synth.errors import InputError

JOURNAL_FOLDER = "journal"


def put_sample(url: str, sample: Sample, job: Job) -> ManifestEntry:
    """Writes URL/samples/NNNNNN; any process may do it.

    Raises:
        InputError: The storage refuses.
    """
    with tempfile.TemporaryDirectory(prefix="synth-") as folder:
        entry = write_sample_files(Path(folder), sample, job)
        name = f"{SAMPLES_FOLDER}/{sample_name(sample.index)}"
        UrlStore(url).put_folder(Path(folder) / name, name)
    return entry


class UrlWriter(Finalising):
    """As `synth.dataset.writer.DatasetWriter`, for a URL."""

    def __init__(self, url: str, job: Job, shard: Shard | None = None) -> None:
        """Creates the dataset, or goes on with the job that is there.

        Raises:
            InputError: There is another job or something else, another process is writing, or the storage refuses.
        """
        self.url, self.job = url.rstrip("/"), job
        self._store, self._shard = UrlStore(self.url), shard
        self._run: Mapping[str, Any] | None = None
        record = self._there()
        self._lease = Lease(self._store, shard)
        try:
            content = job.record() if record is None else continued(job, record)
            if content != record:
                self._store.write(DATASET_FILE, to_document(content).encode("utf-8"))
            self._asked_for = int(content["n"])
            self._temporary = tempfile.TemporaryDirectory(prefix="synth-")
            self._local = Path(self._temporary.name)
            self._fetch_lines()
        except BaseException:
            self._lease.release()
            raise

    @property
    def finished(self) -> set[int]:
        """Indices of the finished samples."""
        return set(self._finished)

    def record(self, entry: ManifestEntry) -> None:
        """Counts a sample whose objects `put_sample` has put; again for a known one: nothing.

        Raises:
            InputError: The storage refuses, or the objects are not there.
        """
        if entry.index in self._finished:
            return
        name = sample_name(entry.index)
        if not self._store.exists(f"{SAMPLES_FOLDER}/{name}/meta.json"):
            raise InputError(f"{self.url}/{SAMPLES_FOLDER}/{name}: the sample is not there; is the storage shared?")
        self._store.write(f"{JOURNAL_FOLDER}/{name}.json", to_line(entry.record()).encode("utf-8"))
        append_line(self._local / MANIFEST_FILE, entry.record())
        self._finished.add(entry.index)

    def fail(self, index: int, draw: int, stage: str, reason: str, last_good_state: Any = None) -> None:
        """Records a draw that failed, once; see `DatasetWriter.fail`.

        Raises:
            InputError: The storage refuses.
        """
        if (index, draw) in self._failed:
            return
        record = {"index": index, "draw": draw, "stage": stage, "reason": reason, "last_good_state": last_good_state}
        self._store.write(f"{JOURNAL_FOLDER}/{sample_name(index)}-{draw}.json", to_line(record).encode("utf-8"))
        append_line(self._local / FAILURES_FILE, record)
        self._failed.add((index, draw))

    @contextmanager
    def making_meshes(self) -> Iterator[Path]:
        """The folder of meshes; what is made within is put under the URL.

        Raises:
            InputError: In a shard, when a mesh was made: another shard might have made another one.
        """
        folder = fetched_meshes(self.url)
        before = set(folder.iterdir())
        yield folder
        if made := set(folder.iterdir()) - before:
            if self._shard is not None:
                raise InputError(
                    f"{self.url}: shards need the mesh to be there: give the command with --n 1, without --shard, first"
                )
            for path in made:
                self._store.put_file(path, f"{MESHES_FOLDER}/{path.name}")

    def note_run(self, run: Mapping[str, Any]) -> None:
        """See `DatasetWriter.note_run`."""
        self._run = run

    def finalise(self) -> None:
        """Puts manifest, failures and summary together and removes the journal; a shard leaves that to a plain run.

        Raises:
            InputError: The storage refuses; the journal is still there.
        """
        if self._shard is not None:
            return
        self._sort_lines()
        for name in (MANIFEST_FILE, FAILURES_FILE):
            self._store.put_file(self._local / name, name)
        if self._run is not None:
            self._store.write(SUMMARY_FILE, summary_document(self._local, self._run, self._asked_for))
        self._store.delete(f"{JOURNAL_FOLDER}/{name}" for name in self._store.names(JOURNAL_FOLDER))

    def close(self) -> None:
        """Lets other processes write; harmless when repeated."""
        self._lease.release()
        self._temporary.cleanup()

    def _there(self) -> dict[str, Any] | None:
        """The job that is there, if it is this one; None where there is nothing."""
        content = self._store.read(DATASET_FILE)
        if content is None:
            if strange := self._store.names():
                raise InputError(f"{self.url}: holds {', '.join(strange[:5])} but no dataset; give another --out")
            return None
        try:
            record = json.loads(content)
        except ValueError as error:
            raise InputError(f"{self.url}/{DATASET_FILE}: not valid JSON ({error}); the object is damaged") from error
        check_record(record, f"{self.url}/{DATASET_FILE}")
        refuse_another_job(self.job, record, self.url)
        return dict(record)

    def _fetch_lines(self) -> None:
        for name in (MANIFEST_FILE, FAILURES_FILE):
            if not self._store.get_file(name, self._local / name):
                (self._local / name).touch()
        for name in self._store.names(JOURNAL_FOLDER):
            line = json.loads(self._store.read(f"{JOURNAL_FOLDER}/{name}") or b"null")
            if line is not None:
                append_line(self._local / (FAILURES_FILE if "draw" in line else MANIFEST_FILE), line)
        self._sort_lines()
        self._finished = set(scan_lines(self._local / MANIFEST_FILE, manifest_key).places)
        self._failed = set(scan_lines(self._local / FAILURES_FILE, failure_key).places)

    def _sort_lines(self) -> None:
        manifest = scan_lines(self._local / MANIFEST_FILE, manifest_key).places
        rewrite_lines(self._local / MANIFEST_FILE, [manifest[key] for key in sorted(manifest)])
        failures = scan_lines(self._local / FAILURES_FILE, failure_key).places
        rewrite_lines(self._local / FAILURES_FILE, [failures[key] for key in sorted(failures)])


def fetched_meshes(url: str) -> Path:
    """A local folder with all meshes that are under the URL now.

    Raises:
        InputError: The storage refuses.
    """
    folder, store = Path(_mesh_folder(url).name), UrlStore(url)
    for name in store.names(MESHES_FOLDER):
        if not (folder / name).exists():
            store.get_file(f"{MESHES_FOLDER}/{name}", folder / name)
    return folder


@cache
def _mesh_folder(url: str) -> "tempfile.TemporaryDirectory[str]":
    """One per process and URL, removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="synth-meshes-")
