"""Members of a shard: where a file lies in an uncompressed tar, and reading it and the flow that such files hold.

A member is read by opening the shard, one seek and one read; nothing stays open, so that loader workers and processes
share no file handle. PNG images carry checksums. `.npy` arrays carry none: their type, shape and size are checked, but
a flipped bit among their numbers is not noticed.

Reference: NumPy's file format, numpy.lib.format.
"""

import errno
import io
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gelflow.errors import InputError
from gelflow.files.exr import FlowField
from gelflow.untrusted import MOST_BYTES, open_file

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, slots=True)
class Member:
    """One file in a shard, which readers of images can use like a path; its content lies at `offset`, in bytes."""

    shard: Path
    name: str
    offset: int
    size: int

    def __str__(self) -> str:
        return f"{self.shard}, member {self.name}"

    def is_file(self) -> bool:
        return self.shard.is_file()

    def read_bytes(self) -> bytes:
        """The content; InputError where the shard cannot be read or has become shorter, or a .png is none."""
        try:
            if self.size > MOST_BYTES:
                raise OSError(errno.EFBIG, f"is larger than {MOST_BYTES} bytes")
            with open_file(self.shard) as file:
                file.seek(self.offset)
                data = file.read(self.size)
        except OSError as error:
            raise InputError(f"{self}: cannot be read: {error.strerror or error}") from error
        if len(data) < self.size:
            raise InputError(f"{self}: ends after {len(data)} of {self.size} bytes; the shard changed after opening")
        if self.name.endswith(".png") and not data.startswith(_PNG_SIGNATURE):
            raise InputError(f"{self}: not a PNG file, or damaged; export or copy the shard again")
        return data


@dataclass(frozen=True, slots=True)
class FlowMembers:
    """The exact flow of one pair in a shard: `.npy` files of flow and visibility, forward, and of contact or None."""

    forward: Member
    forward_visible: Member
    contact: Member | None = None

    def __str__(self) -> str:
        return str(self.forward)

    def read(self) -> FlowField:
        """The flow, as `gelflow.files.exr.read_flow` gives it.

        InputError where an array is damaged or of another type or shape.
        """
        flow, visible = _read_array(self.forward, np.float32), _read_array(self.forward_visible, np.uint8)
        if flow.ndim != 3 or flow.shape[2] != 2 or visible.shape != flow.shape[:2]:
            raise InputError(f"{self}: shapes {flow.shape} and {visible.shape} of flow and visibility; "
                             "(rows, columns, 2) and (rows, columns) are needed")  # fmt: skip
        contact = None if self.contact is None else _read_array(self.contact, np.float32) > 0.5
        if contact is not None and contact.shape != visible.shape:
            raise InputError(f"{self.contact}: shape {contact.shape}; {visible.shape} is needed")
        finite = np.isfinite(flow).all(axis=-1)
        return FlowField(flow, np.asarray(finite & (visible > 0), np.bool_), contact)


def _read_array(member: Member, dtype: type[np.generic]) -> NDArray[Any]:
    stream = io.BytesIO(member.read_bytes())
    try:
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError, tokenize.TokenError) as error:
        raise InputError(f"{member}: not a readable .npy file, truncated or damaged ({error})") from error
    if array.dtype != dtype:
        raise InputError(f"{member}: {array.dtype} values; {np.dtype(dtype)} is needed")
    return array
