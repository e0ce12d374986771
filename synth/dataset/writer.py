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
    DIR/shards/           lines of shards that run, or were stopped; of any run under a URL in journal/

A sample is finished when its files are whole and its line is on record, written in this order. Whatever a killed run
leaves (a torn line, a hidden partial folder, a folder without a line) is put right on the next opening. What differs
between a directory and a URL is in `synth.dataset.store`, how a line is recorded in `synth.dataset.manifest_lines`.
"""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from synth.dataset.atomic_files import PARTIAL
from synth.dataset.job import DATASET_FILE, Job, check_record, continued, refuse_another_job
from synth.dataset.jsontext import parse_document, to_document
from synth.dataset.lock import LEASES_FOLDER, LOCK_FILE
from synth.dataset.manifest import FAILURES_FILE, MANIFEST_FILE, Failure, ManifestEntry
from synth.dataset.sample import Layout, sample_name
from synth.dataset.shard import Shard
from synth.dataset.store import Output, open_store
from synth.dataset.summary import SUMMARY_FILE, summary_document
from synth.errors import InputError


class DatasetWriter:
    """Writes one job's samples; one process holds it, workers call `write_sample_files` and hand back the entry.

    For `with`, which finalises, unless an error is on its way that this might hide, and closes.
    """

    run: Mapping[str, Any] | None = None
    """What `finalise` writes to summary.json about this run, beside the totals of the dataset."""

    def __init__(self, out: Output, job: Job, shard: Shard | None = None, per_trajectory: int = 1) -> None:
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
        self._store, self.job, self._shard = open_store(out), job, shard
        self._layout = Layout.of(job.scene)
        self._check_place()
        self._closing = contextlib.ExitStack()
        self._lock = self._store.lock()
        self._closing.callback(self._lock.release)
        self._lines = self._closing.enter_context(self._store.lines(self._layout))
        try:
            with self._lock.join(shard) as alone:
                self._adopt_job()
                self._finished, self._failed = self._lines.begin(shard, per_trajectory, alone)
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
        if not self._store.holds(self._layout, entry.index):
            raise InputError(
                f"{self._store.out}/{self._layout.folder}/{name}: the sample's files are not there; were they written "
                "to another place, or to storage that is not shared?"
            )
        self._lines.add(MANIFEST_FILE, name, vars(entry))
        self._finished.add(entry.index)

    def fail(self, failure: Failure) -> None:
        """Records an attempt that failed, once, also over several runs."""
        key = (failure.index, failure.draw)
        if key not in self._failed:
            self._lines.add(FAILURES_FILE, f"{sample_name(failure.index)}-{failure.draw}", vars(failure))
            self._failed.add(key)

    @contextlib.contextmanager
    def making_meshes(self) -> Iterator[Path]:
        """The folder of meshes that all who write this dataset share; within, nobody else makes one in a directory.

        InputError where a mesh was made in a shard under a URL: another shard might have made another one.
        """
        with self._lock.setup(), self._store.making_meshes(self._shard) as folder:
            yield folder

    def finalise(self) -> None:
        """Merges the lines of all into manifest and failures, writes the summary; in a shard only the last to leave.

        Nothing is lost where the storage refuses (InputError).
        """
        with self._lock.leave(self._shard) as alone:
            if not alone:
                return
            self._lines.merge()
            if self.run is not None:
                asked_for = int((self._record() or self.job.record())["n"])
                self._store.write(SUMMARY_FILE, summary_document(self._lines.folder, self.run, asked_for))
            self._lines.publish()

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
        ours = (LOCK_FILE, LEASES_FOLDER)
        there = self._store.content()
        strange = [name for name in there if name not in ours and PARTIAL not in name]
        if strange and DATASET_FILE not in there:
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
