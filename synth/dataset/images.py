"""Images as PNG: RGB or grey, 8 or 16 bits, the same bytes for the same pixels (no time stamps, fixed compression)."""

import zlib
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from synth.errors import InputError

Raster: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
"""(H, W) grey or (H, W, 3) RGB; uint8 with full scale 255 or uint16 with full scale 65535."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COMPRESSION = 4
"""zlib level; run-length matching makes nothing of it but that it is not zero."""


def encode_png(image: Raster) -> bytes:
    """PNG file of an image.

    Args:
        image: (H, W) or (H, W, 3) RGB, uint8 or uint16.

    Raises:
        ValueError: Another shape or type.
    """
    import cv2

    if image.dtype not in (np.uint8, np.uint16) or not (image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)):
        raise ValueError(f"an image must be (H, W) or (H, W, 3), uint8 or uint16, not {image.shape} {image.dtype}")
    stored = image if image.ndim == 2 else image[:, :, ::-1]
    # Noise repeats itself nowhere: against zlib's search for repetitions, matching runs alone takes half the time, and
    # files come out 1 to 15 % smaller (14 kinds of sensors).
    options = [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    done, data = cv2.imencode(".png", np.ascontiguousarray(stored), options)
    if not done:
        raise ValueError(f"OpenCV could not encode an image of {image.shape} {image.dtype} as PNG")
    return bytes(data)


def read_png(path: Path) -> Raster:
    """The image in a PNG file, as it was given to `encode_png`.

    Raises:
        InputError: The file is missing, is no PNG, is truncated or damaged (each chunk's checksum is tested), or holds
            something other than grey or RGB.
    """
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    _check_chunks(path, data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{path}: OpenCV cannot decode this PNG; the file is damaged")
    if image.ndim == 3 and image.shape[2] != 3:
        raise InputError(f"{path}: has {image.shape[2]} channels; allowed are 1 (grey) and 3 (RGB)")
    return np.ascontiguousarray(image if image.ndim == 2 else image[:, :, ::-1])


def _check_chunks(path: Path, data: bytes) -> None:
    """Walks the chunks (length, type, data, CRC) to the end marker; decoders fill a truncated image up with black."""
    if not data.startswith(_SIGNATURE):
        raise InputError(f"{path}: not a PNG file")
    place, kind = len(_SIGNATURE), b""
    while kind != b"IEND":
        length = int.from_bytes(data[place : place + 4], "big")
        body = data[place + 4 : place + 8 + length]
        stored = data[place + 8 + length : place + 12 + length]
        if len(stored) < 4:
            raise InputError(
                f"{path}: the PNG file ends after {len(data)} bytes, before its image does; it is truncated"
            )
        if zlib.crc32(body) != int.from_bytes(stored, "big"):
            raise InputError(f"{path}: the checksum of the PNG chunk at byte {place} is wrong; the file is damaged")
        kind = body[:4]
        place += 12 + length
