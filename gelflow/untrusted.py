"""Reading what may come from strangers: regular files of bounded size, text of bounded nesting and numbers."""

import copy
import errno
import os
import re
import tomllib
from collections.abc import Callable
from io import BufferedReader
from pathlib import Path, PurePosixPath
from typing import Any

from gelflow.errors import InputError

MOST_BYTES, MOST_TEXT = 2**32, 2**20
"""Of a file that is read, and of one that a person writes."""
MOST_PIXELS, MOST_VALUES = 2**26, 2**30
"""Of a picture, such as 8192 x 8192; of all channels of a flow file together."""
DEEPEST = 64
"""Parts of the key of KEY=VALUE."""
_LONGEST_LINE = 10_000
"""Characters of a line of TOML, whose parser takes the square of a dotted key's length in time and memory."""


def open_file(path: Path) -> BufferedReader:
    """Opens a regular file for reading; OSError for anything else, so that no pipe or device is ever waited for."""
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "is a folder, a pipe or a device, not a regular file", str(path))
    return path.open("rb")


def read_file(path: Path, most: int = MOST_BYTES) -> bytes:
    """The content of a regular file; OSError where there is none, or it has more than `most` bytes."""
    with open_file(path) as file:
        if os.fstat(file.fileno()).st_size > most:
            raise OSError(errno.EFBIG, f"is larger than {most} bytes, the most that is read", str(path))
        return file.read()


def inside(name: str) -> str:
    """A relative path, as a file gives it, that stays in its folder on every system; ValueError for any other."""
    if not name or re.search(r"[\0-\x1f\x7f-\x9f\\]|^/", name) or ".." in PurePosixPath(name).parts:
        raise ValueError(f"{name!r} leads out of its folder, or is no name of a file")
    return name


def parsed(parse: Callable[[Any], Any], content: bytes | str, where: str) -> Any:
    """What `json.loads` or `tomllib.loads` makes of a text.

    InputError, which names `where`, for another text, one nested so deeply that recursion fails, numbers of more than
    4,300 digits, and lines of TOML of more than 10,000 characters.
    """
    try:
        if parse is tomllib.loads and any(len(line) > _LONGEST_LINE for line in str(content).splitlines()):
            raise ValueError(f"it has a line of more than {_LONGEST_LINE} characters")
        value = parse(content)
        repr(copy.deepcopy(value))  # what follows goes as deep, and prints numbers
    except RecursionError as error:
        raise InputError(f"{where}: is nested too deeply") from error
    except ValueError as error:
        kind = "TOML" if parse is tomllib.loads else "JSON"
        raise InputError(f"{where}: not valid {kind}: {str(error).partition(';')[0]}") from error
    return value


def assigned_value(text: str, where: str) -> Any:
    """The TOML value of KEY=VALUE, or the text itself, as a bare word is; InputError as for `parsed`."""
    try:
        return parsed(tomllib.loads, f"value = {text}", where)["value"]
    except InputError as error:
        if isinstance(error.__cause__, tomllib.TOMLDecodeError):
            return text.strip()
        raise
