"""A folder of objects under an fsspec URL (s3://, gs://, sftp:// ...).

An object store knows neither renaming nor appending nor locks; what is written there relies on none of them: each
object is put or read as a whole. Reference: https://filesystem-spec.readthedocs.io
"""

import contextlib
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from synth.errors import InputError


@contextlib.contextmanager
def refusals(where: str) -> Iterator[None]:
    """Every driver of fsspec has errors of its own, besides OSError: at this border all become one message."""
    try:
        yield
    except Exception as error:
        raise InputError(
            f"{where}: the storage refuses: {type(error).__name__}: {error}; what was finished before is "
            "safe, put this right and give the same command again to go on"
        ) from error


class Objects:
    """Objects by their name in the folder `out`; every method raises InputError where the storage refuses."""

    def __init__(self, out: str) -> None:
        self.out = out.rstrip("/")

    @cached_property
    def _place(self) -> tuple[Any, str]:
        """The file system and the folder's path in it; InputError where its protocol or package is not known."""
        from fsspec.core import url_to_fs

        try:
            system, root = url_to_fs(self.out)
        except (ImportError, ValueError) as error:
            raise InputError(f"--out {self.out}: {error}") from error
        return system, root.rstrip("/")

    @contextlib.contextmanager
    def _at(self, name: str) -> Iterator[tuple[Any, str]]:
        """The file system and an object's path in it."""
        system, root = self._place
        with refusals(f"{self.out}/{name}"):
            yield system, f"{root}/{name}".rstrip("/")

    def read(self, name: str) -> bytes | None:
        """The content; None where there is nothing of that name."""
        with self._at(name) as (system, path), contextlib.suppress(FileNotFoundError):
            return bytes(system.cat_file(path))
        return None

    def write(self, name: str, content: bytes) -> None:
        """Gives an object its content."""
        with self._at(name) as (system, path):
            _make_folder(system, path)
            system.pipe_file(path, content)

    def put(self, path: Path, name: str) -> None:
        """Copies a local file, or the files of a local folder, to objects."""
        with self._at(name) as (system, root):
            for file in sorted(file for file in (path, *path.rglob("*")) if file.is_file()):
                target = f"{root}/{file.relative_to(path).as_posix()}".removesuffix("/.")
                _make_folder(system, target)
                system.put_file(str(file), target)

    def get(self, name: str, path: Path) -> None:
        """Copies an object to a local file; nothing where there is none."""
        with self._at(name) as (system, source):
            if system.exists(source):
                system.get_file(source, str(path))

    def exists(self, name: str) -> bool:
        with self._at(name) as (system, path):
            return bool(system.exists(path))

    def names(self, folder: str = "") -> list[str]:
        """Names of what is directly in a folder; none where there is no such folder."""
        with self._at(folder) as (system, path), contextlib.suppress(FileNotFoundError):
            system.invalidate_cache()
            listed = system.ls(path, detail=False)
            return sorted(str(found).rstrip("/").rpartition("/")[2] for found in listed)
        return []

    def delete(self, names: Iterable[str]) -> None:
        """Removes objects; those that are gone already do not matter."""
        for name in names:
            with self._at(name) as (system, path), contextlib.suppress(FileNotFoundError):
                system.rm_file(path)


def _make_folder(system: Any, target: str) -> None:
    """The folder of an object, where the store has folders."""
    system.makedirs(target.rpartition("/")[0], exist_ok=True)
