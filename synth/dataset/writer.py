"""A dataset directory while it is being written, possibly in several goes.

    DIR/dataset.json      the job
    DIR/manifest.jsonl    a line per finished sample
    DIR/failures.jsonl    a line per failed draw
    DIR/samples/000000/   image1.png image2.png flow.exr meta.json surface.npz, and for each further camera a folder of
                          its name with its own image1.png image2.png flow.exr
    DIR/summary.json      what it took
    DIR/meshes/           of pads with an even edge length
    DIR/.lock             held by the process that writes
    DIR/shards/           lines of shards that run, or that were stopped: see `synth.dataset.shard_writer`

A sample is finished when its folder is whole and its line is in the manifest, written in this order. Whatever a killed
run leaves (a torn line, a hidden partial folder, a folder without a line) is put right on the next opening. `finalise`
sorts both files, so that they do not depend on the number of workers or on interruptions; only `seconds` does.
"""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from synth.dataset.finalising import Finalising
from synth.dataset.job import DATASET_FILE, Job, continued, read_job_record, refuse_another_job
from synth.dataset.joining import FAILURES_FILE, MANIFEST_FILE, failure_key, join_shards, manifest_key
from synth.dataset.jsontext import to_document
from synth.dataset.lines import append_line, rewrite_lines, scan_lines
from synth.dataset.lock import LOCK_FILE, DirectoryLock
from synth.dataset.sample import (
    SAMPLE_FILES,
    SAMPLES_FOLDER,
    VIEW_FILES,
    ManifestEntry,
    Sample,
    further_cameras,
    sample_name,
)
from synth.dataset.sample_files import write_sample_files
from synth.dataset.storage import PARTIAL, remove_partials, replace_file, storage_errors
from synth.dataset.summary import write_summary
from synth.errors import InputError

MESHES_FOLDER = "meshes"


class DatasetWriter(Finalising):
    """Writes one job's samples; one process holds it, workers call `write_sample_files` and hand back the entry."""

    def __init__(self, directory: Path | str, job: Job) -> None:
        """Creates the directory, or goes on with the job that it holds.

        Args:
            directory: empty, missing, or a dataset of the same job (n may differ).
            job: what to write.

        Raises:
            InputError: The directory holds another job (the message lists what differs) or something else, another
                process is writing it, its manifest is damaged, or the storage refuses.
        """
        self.directory = Path(directory)
        self.job = job
        self._home = self.directory
        self._run: Mapping[str, Any] | None = None
        _check_place(self.directory)
        with storage_errors(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
        self._lock = DirectoryLock(self.directory)
        try:
            self._finished, self._failed = self._open()
        except BaseException:
            self._lock.release()
            raise

    @property
    def finished(self) -> set[int]:
        """Indices of the samples that are whole and in the manifest."""
        return set(self._finished)

    @property
    def failed(self) -> set[tuple[int, int]]:
        """(index, draw) of the failures on record."""
        return set(self._failed)

    def write(self, sample: Sample) -> ManifestEntry:
        """Writes a sample's folder and its line in the manifest.

        Raises:
            InputError: The storage refuses; the sample counts as unfinished.
        """
        entry = write_sample_files(self.directory, sample, self.job)
        self.record(entry)
        return entry

    def record(self, entry: ManifestEntry) -> None:
        """Appends the line of a sample whose folder `write_sample_files` has written; again for a known one: nothing.

        Raises:
            InputError: The storage refuses, or the folder is not there.
        """
        if entry.index in self._finished:
            return
        if not self._is_whole(entry.index):
            folder = self.directory / SAMPLES_FOLDER / sample_name(entry.index)
            raise InputError(f"{folder}: the sample's files are not there; was it written to another place?")
        append_line(self._home / MANIFEST_FILE, entry.record())
        self._finished.add(entry.index)

    def fail(self, index: int, draw: int, stage: str, reason: str, last_good_state: Any = None) -> None:
        """Records a draw that failed, once, also over several runs.

        Args:
            index: the sample that it was to become.
            draw: 0 for the first draw, 1 for the next.
            stage: where it failed, e.g. "simulate".
            reason: for the user.
            last_good_state: JSON-able, or None.

        Raises:
            InputError: The storage refuses.
        """
        if (index, draw) in self._failed:
            return
        record = {"index": index, "draw": draw, "stage": stage, "reason": reason, "last_good_state": last_good_state}
        append_line(self._home / FAILURES_FILE, record)
        self._failed.add((index, draw))

    @contextlib.contextmanager
    def making_meshes(self) -> Iterator[Path]:
        """The folder of meshes that all who write this dataset share; within, nobody else makes one."""
        with self._lock.setup():
            yield self.directory / MESHES_FOLDER

    def note_run(self, run: Mapping[str, Any]) -> None:
        """What `finalise` writes to summary.json about this run, beside the totals of the dataset."""
        self._run = run

    def finalise(self) -> None:
        """Sorts manifest and failures by index, writes the summary; called on leaving a `with` block, too.

        Raises:
            InputError: The storage refuses; the files are as before.
        """
        self._tidy()
        if self._run is not None:
            write_summary(self.directory, self._run)

    def close(self) -> None:
        """Lets other processes write; harmless when repeated."""
        self._lock.release()

    def _open(self) -> tuple[set[int], set[tuple[int, int]]]:
        """Take the dataset for this process; what is finished and what has failed."""
        self._lock.take_whole()
        self._adopt_job()
        return self._tidy()

    def _tidy(self) -> tuple[set[int], set[tuple[int, int]]]:
        """Put right what interrupted runs left, take in what shards made; nobody else may be writing."""
        with storage_errors(self.directory):
            (self.directory / SAMPLES_FOLDER).mkdir(exist_ok=True)
            remove_partials(self.directory)
            remove_partials(self.directory / SAMPLES_FOLDER)
        join_shards(self.directory)
        return self._repair_manifest(), self._repair_failures()

    def _adopt_job(self) -> None:
        path = self.directory / DATASET_FILE
        if not path.exists():
            replace_file(path, self.job.document())
            return
        record = read_job_record(self.directory)
        refuse_another_job(self.job, record, str(self.directory))
        content = continued(self.job, record)
        if content != record:
            replace_file(path, to_document(content).encode("utf-8"))

    def _repair_manifest(self) -> set[int]:
        path = self.directory / MANIFEST_FILE
        table = scan_lines(path, manifest_key)
        whole = {index: place for index, place in table.places.items() if self._is_whole(index)}
        if not table.tidy or len(whole) < len(table.places) or not path.exists():
            rewrite_lines(path, [whole[index] for index in sorted(whole)])
        return set(whole)

    def _repair_failures(self) -> set[tuple[int, int]]:
        path = self.directory / FAILURES_FILE
        table = scan_lines(path, failure_key)
        if not table.tidy or not path.exists():
            rewrite_lines(path, [table.places[key] for key in sorted(table.places)])
        return set(table.places)

    def _is_whole(self, index: int) -> bool:
        folder = self.directory / SAMPLES_FOLDER / sample_name(index)
        names = [f"{camera}/{name}" for camera in further_cameras(self.job.scene) for name in VIEW_FILES]
        return all((folder / name).is_file() for name in (*SAMPLE_FILES, *names))


def _check_place(directory: Path) -> None:
    """Refuses a file, and a folder with something else in it, before anything in it is touched."""
    if directory.exists() and not directory.is_dir():
        raise InputError(f"{directory}: is a file; --out needs a directory")
    if not directory.is_dir() or (directory / DATASET_FILE).exists():
        return
    with storage_errors(directory):
        strange = sorted(
            entry.name for entry in directory.iterdir() if entry.name != LOCK_FILE and PARTIAL not in entry.name
        )
    if strange and DATASET_FILE not in strange:  # it may have come meanwhile, from another shard
        listed = ", ".join(strange[:5]) + (", ..." if len(strange) > 5 else "")
        raise InputError(f"{directory}: is not empty and not a dataset (it holds {listed}); give another --out")
