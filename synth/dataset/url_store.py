"""Objects under an fsspec URL (s3://, gs://, az://, sftp://, memory:// ...), each put or read as a whole.

An object store knows neither renaming nor appending nor locks; what is written here relies on none of them.
Reference: https://filesystem-spec.readthedocs.io
"""

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from synth.errors import InputError


def is_url(out: str | Path) -> bool:
    """Whether a place is a URL other than of a directory of this machine."""
    return isinstance(out, str) and "://" in out and not out.startswith("file://")


@dataclass(frozen=True)
class UrlStore:
    """A folder of objects.

    Attributes:
        url: of the folder.
    """

    url: str

    @cached_property
    def _place(self) -> tuple[Any, str]:
        """The file system and the folder's path in it.

        Raises:
            InputError: The protocol is unknown, or its package is missing.
        """
        from fsspec.core import url_to_fs

        try:
            system, root = url_to_fs(self.url.rstrip("/"))
        except (ImportError, ValueError) as error:
            raise InputError(f"--out {self.url}: {error}") from error
        return system, root.rstrip("/")

    @property
    def shared(self) -> bool:
        """False where every process sees objects of its own."""
        return "memory" not in self.url.split("://")[0]

    def read(self, name: str) -> bytes | None:
        """An object's content; None where there is no such object.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        with self._errors(name):
            try:
                return bytes(system.cat_file(f"{root}/{name}"))
            except FileNotFoundError:
                return None

    def write(self, name: str, content: bytes) -> None:
        """Gives an object its content.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        with self._errors(name):
            self._prepare(f"{root}/{name}")
            system.pipe_file(f"{root}/{name}", content)

    def put_folder(self, folder: Path, name: str) -> None:
        """Copies the files of a local folder to objects of the same names.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        with self._errors(name):
            for file in sorted(file for file in folder.rglob("*") if file.is_file()):
                target = f"{root}/{name}/{file.relative_to(folder).as_posix()}"
                self._prepare(target)
                system.put_file(str(file), target)

    def get_file(self, name: str, path: Path) -> bool:
        """Copies an object to a local file; False where there is none.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        with self._errors(name):
            if not system.exists(f"{root}/{name}"):
                return False
            system.get_file(f"{root}/{name}", str(path))
            return True

    def put_file(self, path: Path, name: str) -> None:
        """Copies a local file to an object.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        with self._errors(name):
            self._prepare(f"{root}/{name}")
            system.put_file(str(path), f"{root}/{name}")

    def exists(self, name: str) -> bool:
        """Whether there is such an object.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        with self._errors(name):
            return bool(system.exists(f"{root}/{name}"))

    def names(self, folder: str = "") -> list[str]:
        """Names of what is directly in a folder.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        with self._errors(folder):
            system.invalidate_cache()
            try:
                listed = system.ls(f"{root}/{folder}".rstrip("/"), detail=False)
            except FileNotFoundError:
                return []
            return sorted(str(path).rstrip("/").rpartition("/")[2] for path in listed)

    def delete(self, names: Iterable[str]) -> None:
        """Removes objects; those that are gone already do not matter.

        Raises:
            InputError: The storage refuses.
        """
        system, root = self._place
        for name in names:
            with self._errors(name), contextlib.suppress(FileNotFoundError):
                system.rm_file(f"{root}/{name}")

    def _prepare(self, target: str) -> None:
        """The folder of an object, where the store has folders."""
        system, _ = self._place
        system.makedirs(target.rpartition("/")[0], exist_ok=True)

    @contextlib.contextmanager
    def _errors(self, name: str) -> Iterator[None]:
        """Every driver of fsspec has errors of its own, besides OSError: at this border all become one message."""
        try:
            yield
        except (InputError, FileNotFoundError):
            raise
        except Exception as error:
            raise InputError(
                f"{self.url}/{name}: the storage refuses: {type(error).__name__}: {error}; what was finished before is "
                "safe, put this right and give the same command again to go on"
            ) from error
