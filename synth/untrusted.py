"""Reading what may come from strangers: regular files of bounded size, text of bounded nesting and numbers."""

import copy
import errno
import io
import math
import os
import re
import tomllib
import warnings
from collections.abc import Callable
from glob import has_magic
from io import BufferedReader
from itertools import islice, takewhile
from pathlib import Path, PurePosixPath
from typing import Any

from synth.errors import InputError

MOST_BYTES, MOST_TEXT = 2**32, 2**20
"""Of a file that is read, and of one that a person writes."""
MOST_PIXELS, MOST_VALUES = 2**26, 2**30
"""Of a picture, such as 8192 x 8192; of all channels of a flow file together."""
FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "PPM")
MOST_FOLDERS = 20_000
"""Below those in which a scene's wildcards look for files."""
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


def read_toml(path: Path) -> dict[str, Any]:
    """What a TOML file says; InputError as for `parsed`, and where it cannot be read as text."""
    try:
        return dict(parsed(tomllib.loads, read_file(path, MOST_TEXT).decode("utf-8"), str(path)))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def check_picture(content: bytes, where: str, formats: tuple[str, ...] = FORMATS, most: int = MOST_PIXELS) -> None:
    """InputError for no picture, one of more pixels than `most`, and a damaged PNG; nothing is decoded."""
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content), formats=formats) as picture:
            pixels: float = picture.width * picture.height
            picture.verify()  # a PNG's checksums
    except Image.DecompressionBombError:
        pixels = math.inf
    except Exception as error:  # of whatever kind a damaged header causes
        allowed, reason = ", ".join(formats), str(error).partition(" <")[0]
        words = f"{where} is no whole picture of 8 or 16 bits, but truncated, damaged or another kind of file"
        raise InputError(f"{words} ({reason}); allowed: {allowed}") from error
    if pixels > most:
        raise InputError(f"{where} has more than {most} pixels, the most that is read; reduce it")


def matching_files(folder: Path, pattern: str, left: list[int]) -> list[str]:
    """Names of the files that fit a pattern with wildcards, hidden ones left out, relative if the pattern is.

    `left` holds how many folders may still be seen, so that no stranger's pattern goes through a disk; else InputError.
    """
    steps = Path(pattern).parts
    fixed = Path(*takewhile(lambda step: not has_magic(step), steps))
    if len(fixed.parts) == len(steps):
        return []
    left[0] -= sum(1 for _ in islice(os.walk(folder / fixed), left[0]))
    if left[0] == 0:
        raise InputError(f"{pattern!r}: more than {MOST_FOLDERS} folders to look through; name the files' own folder")
    matches = (folder / fixed).glob("/".join(steps[len(fixed.parts) :]))
    names = [match.relative_to(folder / fixed) for match in matches if match.is_file()]
    return sorted(str(fixed / name) for name in names if not any(part.startswith(".") for part in name.parts))
