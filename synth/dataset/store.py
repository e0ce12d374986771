"""The place of a dataset: a local directory, or a folder of objects under an fsspec URL (s3://, gs://, sftp:// ...).

In a directory, content takes its place by one rename and is flushed to the disk. An object store knows neither renaming
nor appending nor locks; what is written there relies on none of them: each object is put or read as a whole.
Reference: https://filesystem-spec.readthedocs.io
"""

import contextlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from functools import cache, cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

from synth.dataset.storage import replace_file
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


class Store:
    """Files or objects by their name in a dataset, such as "samples/000000/meta.json".

    Every method raises InputError where the storage refuses. `out` is the place, for messages; `directory` the same
    where it is a local directory, else None.
    """

    def __init__(self, out: Path | str) -> None:
        place = output_of(out)
        self.directory = place if isinstance(place, Path) else None
        self.out = place if isinstance(place, Path) else place.rstrip("/")

    @cached_property
    def _place(self) -> tuple[Any, str]:
        """The file system and the root's path in it.

        InputError where the protocol is unknown or its package is missing.
        """
        from fsspec.core import url_to_fs
        from fsspec.implementations.local import LocalFileSystem

        if self.directory is not None:
            return LocalFileSystem(), os.path.abspath(self.directory)
        try:
            system, root = url_to_fs(self.out)
        except (ImportError, ValueError) as error:
            raise InputError(f"--out {self.out}: {error}") from error
        return system, root.rstrip("/")

    def read(self, name: str) -> bytes | None:
        """The content; None where there is nothing of that name."""
        system, root = self._place
        with self._errors(name), contextlib.suppress(FileNotFoundError):
            return (
                bytes(system.cat_file(f"{root}/{name}")) if self.directory is None else read_file(self.directory / name)
            )
        return None

    def write(self, name: str, content: bytes) -> None:
        """Gives a file or an object its content as a whole."""
        if self.directory is not None:
            replace_file(self.directory / name, content)
            return
        system, root = self._place
        with self._errors(name):
            self._make_folder(f"{root}/{name}")
            system.pipe_file(f"{root}/{name}", content)

    def put(self, path: Path, name: str) -> None:
        """Copies a local file, or the files of a local folder, to objects."""
        system, root = self._place
        with self._errors(name):
            for file in sorted(file for file in (path, *path.rglob("*")) if file.is_file()):
                target = f"{root}/{name}/{file.relative_to(path).as_posix()}".removesuffix("/.")
                self._make_folder(target)
                system.put_file(str(file), target)

    def get(self, name: str, path: Path) -> None:
        """Copies an object to a local file; nothing where there is none."""
        system, root = self._place
        with self._errors(name):
            if system.exists(f"{root}/{name}"):
                system.get_file(f"{root}/{name}", str(path))

    def exists(self, name: str) -> bool:
        system, root = self._place
        with self._errors(name):
            return bool(system.exists(f"{root}/{name}"))

    def names(self, folder: str = "") -> list[str]:
        """Names of what is directly in a folder; none where there is no such folder."""
        system, root = self._place
        with self._errors(folder), contextlib.suppress(FileNotFoundError):
            system.invalidate_cache()
            listed = system.ls(f"{root}/{folder}".rstrip("/"), detail=False)
            return sorted(str(path).rstrip("/").rpartition("/")[2] for path in listed)
        return []

    def delete(self, names: Iterable[str]) -> None:
        """Removes objects; those that are gone already do not matter."""
        system, root = self._place
        for name in names:
            with self._errors(name), contextlib.suppress(FileNotFoundError):
                system.rm_file(f"{root}/{name}")

    def _make_folder(self, target: str) -> None:
        """The folder of an object, where the store has folders."""
        self._place[0].makedirs(target.rpartition("/")[0], exist_ok=True)

    @contextlib.contextmanager
    def _errors(self, name: str) -> Iterator[None]:
        """Every driver of fsspec has errors of its own, besides OSError: at this border all become one message."""
        try:
            yield
        except Exception as error:
            raise InputError(
                f"{self.out}/{name}: the storage refuses: {type(error).__name__}: {error}; what was finished before is "
                "safe, put this right and give the same command again to go on"
            ) from error


def mesh_folder(out: Output) -> Path:
    """A folder of this machine that holds the dataset's meshes; InputError where the storage refuses."""
    store = Store(out)
    if store.directory is not None:
        return store.directory / MESHES_FOLDER
    folder = Path(_temporary_folder(str(store.out)).name)
    for name in store.names(MESHES_FOLDER):
        if not (folder / name).exists():
            store.get(f"{MESHES_FOLDER}/{name}", folder / name)
    return folder


@cache
def _temporary_folder(url: str) -> "tempfile.TemporaryDirectory[str]":
    """One per process and URL, removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="synth-meshes-")
