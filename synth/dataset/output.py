"""Where a dataset is written to: a directory or a URL, whole or one shard of it."""

from contextlib import AbstractContextManager
from pathlib import Path
from urllib.parse import unquote, urlparse

from synth.dataset.job import Job
from synth.dataset.sample import ManifestEntry, Sample
from synth.dataset.sample_files import write_sample_files
from synth.dataset.shard import Shard
from synth.dataset.shard_writer import ShardWriter
from synth.dataset.url_store import UrlStore, is_url
from synth.dataset.url_writer import UrlWriter, fetched_meshes, put_sample
from synth.dataset.writer import MESHES_FOLDER, DatasetWriter

Output = Path | str
"""A local directory, or a URL."""


def output_of(text: str | Path) -> Output:
    """What `--out` means; a `file://` URL is the directory."""
    if isinstance(text, Path) or is_url(text):
        return text
    return Path(unquote(urlparse(text).path)) if text.startswith("file://") else Path(text)


def open_writer(
    out: Output, job: Job, shard: Shard | None, pairs_per_trajectory: int
) -> AbstractContextManager[DatasetWriter | UrlWriter]:
    """The writer for a place; see the writers for what is raised."""
    if isinstance(out, str):
        return UrlWriter(out, job, shard)
    return DatasetWriter(out, job) if shard is None else ShardWriter(out, job, shard, pairs_per_trajectory)


def write_sample(out: Output, sample: Sample, job: Job) -> ManifestEntry:
    """Writes a sample's files; any process may do it, the writer then records the entry.

    Raises:
        InputError: The storage refuses.
    """
    return put_sample(out, sample, job) if isinstance(out, str) else write_sample_files(out, sample, job)


def mesh_folder(out: Output) -> Path:
    """A folder of this machine that holds the dataset's meshes.

    Raises:
        InputError: The storage refuses.
    """
    return fetched_meshes(out) if isinstance(out, str) else out / MESHES_FOLDER


def is_shared(out: Output) -> bool:
    """Whether other processes see what is written."""
    return isinstance(out, Path) or UrlStore(out).shared
