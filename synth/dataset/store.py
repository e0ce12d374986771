"""The place of a dataset, behind one interface: a local directory, or a folder of objects under a URL.

In a directory, content takes its place by one rename and is flushed to the disk; processes see each other by locks.
Under a URL files are made in a folder of this machine's temporary space and copied; notes stand for locks.
"""

import contextlib
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urlparse

from synth.dataset.atomic_files import replace_file, storage_errors
from synth.dataset.jsontext import read_document
from synth.dataset.lock import DirectoryLock, Lease
from synth.dataset.manifest_lines import JournalLines, Lines
from synth.dataset.objects import Objects, refusals
from synth.dataset.sample import Layout, sample_name
from synth.dataset.shard import Shard
from synth.errors import InputError
from synth.untrusted import read_file

Output = Path | str
"""A local directory, or a URL."""
MESHES_FOLDER = "meshes"


def output_of(out: Path | str) -> Output:
    """What `--out` means; a `file://` URL is the directory."""
    if isinstance(out, Path) or ("://" in out and not out.startswith("file://")):
        return out
    return Path(unquote(urlparse(out).path)) if out.startswith("file://") else Path(out)


def is_shared(out: Output) -> bool:
    """Whether other processes see what is written."""
    return isinstance(out, Path) or "memory" not in out.split("://")[0]


class DirectoryStore:
    """A local directory: files by their name in a dataset, such as "samples/000000/meta.json".

    `out` is the place, for messages. Every method raises InputError where the storage refuses.
    """

    def __init__(self, directory: Path) -> None:
        self.out = directory

    def read(self, name: str) -> bytes | None:
        """The content; None where there is nothing of that name."""
        with refusals(f"{self.out}/{name}"), contextlib.suppress(FileNotFoundError):
            return read_file(self.out / name)
        return None

    def write(self, name: str, content: bytes) -> None:
        """Gives a file its content as a whole."""
        replace_file(self.out / name, content)

    def content(self) -> list[str]:
        """Names of what is there; InputError where it is nothing that a dataset may be written into."""
        if not self.out.exists():
            return []
        if not self.out.is_dir():
            raise InputError(f"{self.out}: is a file; --out needs a directory")
        with refusals(f"{self.out}/"):
            paths = sorted(self.out.iterdir())
        for path in paths:
            if path.is_symlink():
                raise InputError(f"{path}: is a link; a dataset is written in its own folder alone")
        return [path.name for path in paths]

    def lock(self) -> DirectoryLock:
        """What says who may write; holds nothing yet."""
        with storage_errors(self.out):
            self.out.mkdir(parents=True, exist_ok=True)
        return DirectoryLock(self.out)

    @contextlib.contextmanager
    def lines(self, layout: Layout) -> Iterator[Lines]:
        """The lines of manifest and failures, while they are written."""
        yield Lines(self.out, layout.folder, lambda index: self.holds(layout, index))

    def holds(self, layout: Layout, index: int) -> bool:
        """Whether a sample's files are there."""
        folder, frames = self.out / layout.folder / sample_name(index), 2
        if layout.is_of_clips:
            try:
                frames = len(read_document(folder / "meta.json")["frames"])
            except (InputError, KeyError, TypeError):
                return False
        return all((folder / file).is_file() for file in layout.files(frames))

    @contextlib.contextmanager
    def placing(self, name: str) -> Iterator[Path]:
        """A local path for the new content of a folder, which is in the dataset in the end."""
        yield self.out / name

    def meshes(self) -> Path:
        """A folder of this machine that holds the dataset's meshes."""
        return self.out / MESHES_FOLDER

    @contextlib.contextmanager
    def making_meshes(self, shard: Shard | None) -> Iterator[Path]:
        """`meshes`; what is made there is in the dataset in the end, or InputError where a shard may not make any."""
        yield self.meshes()


class RemoteStore(Objects):
    """A folder of objects under a URL, with the methods of a `DirectoryStore`."""

    def content(self) -> list[str]:
        return self.names()

    def lock(self) -> Lease:
        return Lease(self)

    @contextlib.contextmanager
    def lines(self, layout: Layout) -> Iterator[Lines]:
        with tempfile.TemporaryDirectory(prefix="synth-") as copy:
            yield JournalLines(Path(copy), layout.folder, self)

    def holds(self, layout: Layout, index: int) -> bool:
        """One object is asked for; a line is recorded after all of them were put."""
        return self.exists(f"{layout.folder}/{sample_name(index)}/meta.json")

    @contextlib.contextmanager
    def placing(self, name: str) -> Iterator[Path]:
        with tempfile.TemporaryDirectory(prefix="synth-") as temporary:
            yield Path(temporary) / name
            self.put(Path(temporary) / name, name)

    def meshes(self) -> Path:
        folder = Path(_temporary_folder(self.out).name)
        for name in self.names(MESHES_FOLDER):
            if not (folder / name).exists():
                self.get(f"{MESHES_FOLDER}/{name}", folder / name)
        return folder

    @contextlib.contextmanager
    def making_meshes(self, shard: Shard | None) -> Iterator[Path]:
        folder = self.meshes()
        before = set(folder.glob("*"))
        yield folder
        for path in set(folder.glob("*")) - before:
            if shard is not None:  # another shard might have made another one meanwhile
                raise InputError(
                    f"{self.out}: shards need the mesh to be there: give the command with --n 1, without --shard, first"
                )
            self.put(path, f"{MESHES_FOLDER}/{path.name}")


Store = DirectoryStore | RemoteStore
"""What a writer needs of a place: they have the same methods."""


def open_store(out: Output) -> Store:
    """The store at a place."""
    place = output_of(out)
    return DirectoryStore(place) if isinstance(place, Path) else RemoteStore(place)


@cache
def _temporary_folder(url: str) -> "tempfile.TemporaryDirectory[str]":
    """One per process and URL, removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="synth-meshes-")
