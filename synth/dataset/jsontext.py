"""JSON text of this project's files: keys in the order given, exact for float64, strict (no NaN, no Infinity).

Python prints the shortest decimal that reads back as the same float64, so equal data give equal bytes. A number that is
not finite has no JSON form and becomes `null`.
"""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from synth.errors import InputError
from synth.untrusted import parsed, read_file

_BREAK = re.compile(r"\n\s+")


def jsonable(value: object) -> Any:
    """The value with NumPy arrays, tuples, paths and pydantic models turned into JSON's types.

    TypeError for something that has no JSON form.
    """
    return to_jsonable_python(value, by_alias=False, inf_nan_mode="null", fallback=_numpy)


def _numpy(value: object) -> Any:
    """What pydantic leaves to us."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def to_line(value: object) -> str:
    """One line of a .jsonl file, with its newline."""
    return json.dumps(jsonable(value), ensure_ascii=False, allow_nan=False, separators=(", ", ": ")) + "\n"


def to_document(value: object) -> str:
    """A .json file that a person can read: indented, with lists of plain values on one line."""
    text = json.dumps(jsonable(value), ensure_ascii=False, allow_nan=False, indent=1)
    # A newline in a string is escaped, so a real one is always indentation.
    return re.sub(r"\[\n\s+([^\[\]{}]*?)\n\s+\]", lambda found: f"[{re.sub(_BREAK, ' ', found[1])}]", text) + "\n"


def read_document(path: Path) -> dict[str, Any]:
    """The object in a .json file; InputError where it is missing, unreadable, or holds no JSON object."""
    try:
        return parse_document(read_file(path), str(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error


def parse_document(content: bytes, where: str) -> dict[str, Any]:
    """The object in the content of a .json file; InputError where it holds none, with `where` in the message."""
    value = parsed(json.loads, content, where)
    if not isinstance(value, dict):
        raise InputError(f"{where}: holds a JSON {type(value).__name__}, not an object; the file is damaged")
    return value
