"""A dataset while it is being written, possibly in several goes: in a directory or under a URL, whole or a shard of it.

    DIR/dataset.json      the job
    DIR/manifest.jsonl    a line per finished sample
    DIR/failures.jsonl    a line per failed attempt
    DIR/samples/000000/   of pairs: image1.png image2.png flow.exr meta.json surface.npz, and for each further camera
                          a folder of its name with its own image1.png image2.png flow.exr
    DIR/clips/000000/     of clips: frames/000000.png ... flow/000001.exr ... markers.csv states.csv meta.json
                          surface.npz, and for each further camera a folder with its own frames, flow and markers.csv
    DIR/summary.json      what it took
    DIR/meshes/           of pads with an even edge length
    DIR/.lock             held by the processes that write; under a URL notes in leases/
    DIR/shards/i-of-N/    lines of shards that run, or that were stopped
    URL/journal/          the lines of any run under a URL, each in an object of its own, as nothing can be appended

A sample is finished when its files are whole and its line is on record, written in this order. Whatever a killed run
leaves (a torn line, a hidden partial folder, a folder without a line) is put right on the next opening. A run that ends
merges all lines into manifest and failures, sorted, so that they do not depend on the number of workers or on
interruptions; only `seconds` does. In a directory shards do so, too: whichever is alone, the first to come or the last
to leave. Under a URL none knows to be the last, and a plain run does it.
"""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from synth.dataset.job import DATASET_FILE, Job, check_record, continued, refuse_another_job
from synth.dataset.jsontext import parse_document, read_document, to_document, to_line
from synth.dataset.lock import LEASES_FOLDER, LOCK_FILE, DirectoryLock, Lease
from synth.dataset.manifest import (
    FAILURES_FILE,
    MANIFEST_FILE,
    Failure,
    ManifestEntry,
    append_line,
    failure_key,
    manifest_key,
    merge_lines,
    scan_lines,
)
from synth.dataset.sample import Layout, sample_name
from synth.dataset.shard import Shard
from synth.dataset.storage import PARTIAL, remove_partials, storage_errors
from synth.dataset.store import MESHES_FOLDER, Store, mesh_folder
from synth.dataset.summary import SUMMARY_FILE, summary_document
from synth.errors import InputError

SHARDS_FOLDER = "shards"
JOURNAL_FOLDER = "journal"

_Known = tuple[set[int], set[tuple[int, int]]]
"""Indices of finished samples; index and attempt of failures."""


class DatasetWriter:
    """Writes one job's samples; one process holds it, workers call `write_sample_files` and hand back the entry.

    For `with`, which finalises, unless an error is on its way that this might hide, and closes.
    """

    _whole: Path
    """The folder of this machine with the lines of all: the dataset's, or a temporary copy of what is under the URL."""
    _own: Path
    """The folder that takes this process's lines: the same, or a shard's."""
    run: Mapping[str, Any] | None = None
    """What `finalise` writes to summary.json about this run, beside the totals of the dataset."""

    def __init__(self, out: Path | str, job: Job, shard: Shard | None = None, per_trajectory: int = 1) -> None:
        """Creates the dataset, or goes on with the job that is there.

        Args:
            out: a directory or a URL: empty, missing, or a dataset of the same job (n may differ).
            job: what to write; the same for all shards.
            shard: the part of the job that this process makes; None for all of it.
            per_trajectory: samples i, i + 1, ... of that number belong to a trajectory, and so to one shard.

        Raises:
            InputError: The place holds another job (the message lists what differs) or something else, another process
                is writing it or this shard, it is being made in another number of shards, its manifest is damaged, or
                the storage refuses.
        """
        self._store, self.job, self._shard, self._per_trajectory = Store(out), job, shard, per_trajectory
        self._layout = Layout.of(job.scene)
        self._directory = self._store.directory
        self._check_place()
        self._closing = contextlib.ExitStack()
        self._lock: DirectoryLock | Lease
        if self._directory is None:
            self._whole = Path(self._closing.enter_context(tempfile.TemporaryDirectory(prefix="synth-")))
            self._lock = Lease(self._store)
        else:
            self._whole = self._directory
            with storage_errors(self._directory):
                self._directory.mkdir(parents=True, exist_ok=True)
            self._lock = DirectoryLock(self._directory)
        self._closing.callback(self._lock.release)
        self._own = self._whole
        try:
            with self._lock.join(shard) as alone:
                self._adopt_job()
                if self._directory is None:
                    self._fetch_lines()
                if alone or self._directory is None:
                    self._finished, self._failed = self._merge()
                if shard is not None and self._directory is not None:
                    self._finished, self._failed = self._begin_shard(self._directory, shard)
        except BaseException:
            self.close()
            raise

    @property
    def finished(self) -> set[int]:
        """Indices of the samples that are whole and on record; of a shard in a directory only its own."""
        return set(self._finished)

    def record(self, entry: ManifestEntry) -> None:
        """Appends the line of a sample whose files are there (else InputError); again for a known one: nothing."""
        if entry.index in self._finished:
            return
        name = sample_name(entry.index)
        if not self._is_whole(entry.index):
            raise InputError(
                f"{self._store.out}/{self._layout.folder}/{name}: the sample's files are not there; were they written "
                "to another place, or to storage that is not shared?"
            )
        self._append(MANIFEST_FILE, name, vars(entry))
        self._finished.add(entry.index)

    def fail(self, failure: Failure) -> None:
        """Records an attempt that failed, once, also over several runs."""
        key = (failure.index, failure.draw)
        if key not in self._failed:
            self._append(FAILURES_FILE, f"{sample_name(failure.index)}-{failure.draw}", vars(failure))
            self._failed.add(key)

    @contextlib.contextmanager
    def making_meshes(self) -> Iterator[Path]:
        """The folder of meshes that all who write this dataset share; within, nobody else makes one in a directory.

        InputError where a mesh was made in a shard under a URL: another shard might have made another one.
        """
        with self._lock.setup():
            folder = mesh_folder(self._store.out)
            before = set(folder.glob("*"))
            yield folder
            made = set(folder.glob("*")) - before
        if self._directory is not None or not made:
            return
        if self._shard is not None:
            raise InputError(
                f"{self._store.out}: shards need the mesh to be there: give the command with --n 1, without --shard, "
                "first"
            )
        for path in made:
            self._store.put(path, f"{MESHES_FOLDER}/{path.name}")

    def finalise(self) -> None:
        """Merges the lines of all into manifest and failures, writes the summary; in a shard only the last to leave.

        Nothing is lost where the storage refuses (InputError).
        """
        with self._lock.leave(self._shard) as alone:
            if not alone:
                return
            self._merge()
            if self._directory is None:
                for name in (MANIFEST_FILE, FAILURES_FILE):
                    self._store.put(self._whole / name, name)
            if self.run is not None:
                asked_for = int((self._record() or self.job.record())["n"])
                self._store.write(SUMMARY_FILE, summary_document(self._whole, self.run, asked_for))
            if self._directory is None:
                self._store.delete(f"{JOURNAL_FOLDER}/{name}" for name in self._store.names(JOURNAL_FOLDER))

    def close(self) -> None:
        """Lets other processes write; harmless when repeated."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None or isinstance(error, KeyboardInterrupt):
                self.finalise()
        finally:
            self.close()

    def _check_place(self) -> None:
        """Refuses a file, and a folder with something else in it, before anything in it is touched."""
        if self._directory is not None and self._directory.exists() and not self._directory.is_dir():
            raise InputError(f"{self._directory}: is a file; --out needs a directory")
        for path in [] if self._directory is None else map(self._directory.joinpath, self._store.names()):
            if path.is_symlink():
                raise InputError(f"{path}: is a link; a dataset is written in its own folder alone")
        ours = (LOCK_FILE, LEASES_FOLDER)
        strange = [name for name in self._store.names() if name not in ours and PARTIAL not in name]
        if strange and not self._store.exists(DATASET_FILE):
            listed = ", ".join(strange[:5]) + (", ..." if len(strange) > 5 else "")
            raise InputError(
                f"{self._store.out}: not a dataset: holds {listed} but no {DATASET_FILE}; give another --out"
            )

    def _record(self) -> dict[str, Any] | None:
        """The content of dataset.json; None where there is none."""
        content, where = self._store.read(DATASET_FILE), f"{self._store.out}/{DATASET_FILE}"
        return None if content is None else check_record(parse_document(content, where), where)

    def _adopt_job(self) -> None:
        record = self._record()
        if record is not None:
            refuse_another_job(self.job, record, str(self._store.out))
        content = self.job.record() if record is None else continued(self.job, record)
        if content != record:
            self._store.write(DATASET_FILE, to_document(content).encode("utf-8"))

    def _append(self, file: str, name: str, record: Mapping[str, Any]) -> None:
        """Adds a line to this process's file; under a URL that is a copy, and an object of this name is what counts."""
        if self._directory is None:
            self._store.write(f"{JOURNAL_FOLDER}/{name}.json", to_line(record).encode("utf-8"))
        append_line(self._own / file, record)

    def _fetch_lines(self) -> None:
        """Copies manifest, failures and journal from the URL to `_whole`."""
        for name in (MANIFEST_FILE, FAILURES_FILE):
            self._store.get(name, self._whole / name)
        for name in self._store.names(JOURNAL_FOLDER):
            if content := self._store.read(f"{JOURNAL_FOLDER}/{name}"):
                line = parse_document(content, name)
                append_line(self._whole / (FAILURES_FILE if "draw" in line else MANIFEST_FILE), line)

    def _merge(self) -> _Known:
        """Puts right what interrupted runs left, takes in what shards made; nobody else may be writing `_whole`.

        The lines of shards are merged before their folder is removed: a stop in between leaves lines twice, which count
        once.
        """
        shards = self._whole / SHARDS_FOLDER
        if self._directory is not None:
            with storage_errors(self._directory):
                (self._directory / self._layout.folder).mkdir(exist_ok=True)
                remove_partials(self._directory)
                remove_partials(self._directory / self._layout.folder)
        homes = sorted(shards.glob("*-of-*"))
        finished = merge_lines(
            self._whole / MANIFEST_FILE,
            manifest_key,
            [home / MANIFEST_FILE for home in homes],
            keep=lambda index: self._directory is None or self._is_whole(index),
        )
        failed = merge_lines(self._whole / FAILURES_FILE, failure_key, [home / FAILURES_FILE for home in homes])
        if shards.is_dir():
            with storage_errors(shards):
                shutil.rmtree(shards)
        return finished, failed

    def _begin_shard(self, directory: Path, shard: Shard) -> _Known:
        """Makes DIR/shards/i-of-N/, or puts right what this shard's killed process left in it."""
        folder = directory / SHARDS_FOLDER
        self._own = folder / shard.name
        with storage_errors(self._own):
            (directory / self._layout.folder).mkdir(exist_ok=True)
            others = [home.name for home in folder.iterdir()] if folder.is_dir() else []
            strange = [name for name in others if not name.endswith(f"-of-{shard.count}")]
            if strange:
                raise InputError(
                    f"{directory}: is being made in another number of shards ({strange[0]}); wait for these to end"
                )
            self._own.mkdir(parents=True, exist_ok=True)
            remove_partials(self._own)
            remove_partials(directory / self._layout.folder, lambda name: name.isdecimal() and self._makes(int(name)))
        recorded = {*scan_lines(self._whole / MANIFEST_FILE, manifest_key).places}
        recorded |= merge_lines(self._own / MANIFEST_FILE, manifest_key)
        failed = {*scan_lines(self._whole / FAILURES_FILE, failure_key).places}
        failed |= merge_lines(self._own / FAILURES_FILE, failure_key)
        return {index for index in recorded if self._makes(index) and self._is_whole(index)}, failed

    def _makes(self, index: int) -> bool:
        return self._shard is None or self._shard.makes(index // self._per_trajectory)

    def _is_whole(self, index: int) -> bool:
        """Whether a sample's files are there; under a URL its last one."""
        name = f"{self._layout.folder}/{sample_name(index)}"
        if self._directory is None:
            return self._store.exists(f"{name}/meta.json")
        folder, frames = self._directory / name, 2
        if self._layout.is_of_clips:
            try:
                frames = len(read_document(folder / "meta.json")["frames"])
            except (InputError, KeyError, TypeError):
                return False
        return all((folder / file).is_file() for file in self._layout.files(frames))
