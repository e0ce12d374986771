"""Reading a dataset; nothing is cached and nothing is written."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from synth.dataset.job import read_job_record
from synth.dataset.manifest import (
    FAILURES_FILE,
    MANIFEST_FILE,
    LineTable,
    ManifestEntry,
    failure_key,
    manifest_key,
    read_line,
    scan_lines,
)
from synth.dataset.sample import Layout, sample_name
from synth.dataset.sample_reader import ClipData, SampleData, read_clip, read_sample, read_scene
from synth.errors import InputError
from synth.scene import Scene
from synth.untrusted import inside, open_file


@dataclass(frozen=True)
class Dataset:
    """A dataset directory as it was when it was opened; iterating reads its finished samples one by one.

    Methods raise InputError for a sample or camera that is not there, and for a file that is missing or damaged. `path`
    is the directory, `info` its dataset.json.
    """

    path: Path
    info: Mapping[str, Any]
    _table: LineTable[int]

    def __len__(self) -> int:
        """Number of finished samples."""
        return len(self._table.places)

    def __iter__(self) -> Iterator[Any]:
        """The finished samples, by index: `SampleData` of pairs, `ClipData` of clips."""
        return map(self.read_clip if self.layout.is_of_clips else self.read, self.samples)

    @cached_property
    def layout(self) -> Layout:
        return Layout.of(self.info["scene"])

    @property
    def samples(self) -> list[int]:
        """Indices of the finished samples, ascending."""
        return sorted(self._table.places)

    @property
    def failures(self) -> list[dict[str, Any]]:
        """The records of failures.jsonl, by index and attempt."""
        path = self.path / FAILURES_FILE
        table = scan_lines(path, failure_key)
        return [read_line(path, table.places[key]) for key in sorted(table.places)]

    def folder(self, index: int) -> Path:
        """The sample's folder, DIR/samples/NNNNNN or DIR/clips/NNNNNN."""
        if index not in self._table.places:
            known = self.samples
            span = f"{known[0]} to {known[-1]} ({len(known)} of {self.info['n']})" if known else "none"
            raise InputError(f"{self.path}: has no finished sample {index}; it has {span}")
        return self.path / self.layout.folder / sample_name(index)

    def entry(self, index: int) -> ManifestEntry:
        self.folder(index)
        return ManifestEntry.from_record(read_line(self.path / MANIFEST_FILE, self._table.places[index]))

    def scene_of(self, index: int) -> Scene:
        """The scene instance that the sample was made from."""
        return read_scene(self.folder(index))

    def read(self, index: int, camera: str = "") -> SampleData:
        """A pair's files; image1, image2 and flow are those of the camera of that name, by default the main one."""
        if self.layout.is_of_clips:
            raise InputError(f"{self.path}: holds clips, not pairs")
        return read_sample(self.folder(index)).seen_by(camera)

    def read_clip(self, index: int, camera: str = "") -> ClipData:
        """A clip as that camera saw it, by default the main one; images and flows are read when they are asked for."""
        if not self.layout.is_of_clips:
            raise InputError(f"{self.path}: holds pairs, not clips")
        return read_clip(self.folder(index), camera)

    def check_hashes(self, index: int) -> list[str]:
        """One message for each file that is missing or whose content is not what the manifest says; empty: all well."""
        problems = []
        for name, expected in self.entry(index).sha256.items():
            path = self.folder(index) / name
            try:
                with open_file(self.folder(index) / inside(name)) as file:
                    found = hashlib.file_digest(file, "sha256").hexdigest()
                if found != expected:
                    problems.append(f"{path}: sha256 is {found[:16]}..., the manifest says {expected[:16]}...")
            except OSError as error:
                problems.append(f"{path}: cannot be read: {error.strerror or error}")
            except ValueError as error:
                problems.append(f"the manifest's {error}")
        return problems


def read_dataset(path: Path | str) -> Dataset:
    """Opens a dataset directory, finished or not, and writes nothing.

    Args:
        path: what was given to `generate` as `out`; a local directory.

    Returns:
        An iterable of `SampleData` or, of clips, `ClipData`, each read when its turn comes.

    Raises:
        InputError: Not a dataset, or its dataset.json or manifest is damaged.
    """
    directory = Path(path)
    if not directory.is_dir():
        raise InputError(f"{directory}: there is no such directory")
    info = read_job_record(directory)
    manifest = directory / MANIFEST_FILE
    if not manifest.is_file():
        raise InputError(f"{manifest}: missing; the dataset is damaged, or its first run was stopped at once")
    return Dataset(directory, info, scan_lines(manifest, manifest_key))
