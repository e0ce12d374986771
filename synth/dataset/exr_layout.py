"""Is an OpenEXR file whole? Answered from the layout, before the library decodes (and prints about) a truncated one.

    magic 4 bytes, version and flags 4 bytes
    attributes: name NUL, type NUL, size int32, value; ended by a NUL
    offset table: a uint64 for each chunk of scan lines; a writer that was killed leaves zeros
    chunks: first line int32, packed size int32, data

Reference: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

import struct
from pathlib import Path

import numpy as np

from synth.errors import InputError

_MAGIC = b"\x76\x2f\x31\x01"
_NOT_SCAN_LINES = 0x200 | 0x800 | 0x1000
"""Flags of tiled, deep and multi-part files."""
_LINES_PER_CHUNK = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}
"""By the compression's number."""


def check_whole(path: Path) -> None:
    """Reads the file's layout.

    Raises:
        InputError: The file is missing, is no OpenEXR image of scan lines, or ends too early.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if data[:4] != _MAGIC:
        raise InputError(f"{path}: not an OpenEXR file")
    try:
        if struct.unpack_from("<I", data, 4)[0] & _NOT_SCAN_LINES:
            raise InputError(
                f"{path}: a tiled, deep or multi-part OpenEXR file; a flow file has one part of scan lines"
            )
        attributes, table = _attributes(data)
        _, y_min, _, y_max = struct.unpack("<4i", attributes["dataWindow"])
        lines = _LINES_PER_CHUNK.get(attributes["compression"][0], 1)
        chunks = (y_max - y_min) // lines + 1
        offsets = np.frombuffer(data, "<u8", count=chunks, offset=table)
        last = int(offsets.max())
        (packed,) = struct.unpack_from("<i", data, last + 4)
        whole = offsets.min() > 0 and last + 8 + packed <= len(data)
    except (struct.error, ValueError, KeyError, IndexError):
        whole = False
    if not whole:
        raise InputError(
            f"{path}: the OpenEXR file ends after {len(data)} bytes, before its image does; it is truncated"
        )


def _attributes(data: bytes) -> tuple[dict[str, bytes], int]:
    """Values by name, and where the offset table starts; ValueError or struct.error where the header is cut."""
    found: dict[str, bytes] = {}
    place = 8
    while data[place]:
        end_of_name = data.index(b"\0", place)
        end_of_type = data.index(b"\0", end_of_name + 1)
        (size,) = struct.unpack_from("<i", data, end_of_type + 1)
        start = end_of_type + 5
        found[data[place:end_of_name].decode("latin-1")] = data[start : start + size]
        place = start + size
    return found, place + 1
