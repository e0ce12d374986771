"""Images as PNG: RGB or grey, 8 or 16 bits, the same bytes for the same pixels (no time stamps, fixed compression)."""

from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from synth.errors import InputError
from synth.untrusted import check_picture, read_file

Raster: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
"""(H, W) grey or (H, W, 3) RGB; uint8 with full scale 255 or uint16 with full scale 65535."""

_COMPRESSION = 4
"""zlib level; with run-length matching all levels but zero give the same file."""


def encode_png(image: Raster) -> bytes:
    """PNG file of an image, (H, W) or (H, W, 3) RGB, uint8 or uint16."""
    import cv2

    stored = image if image.ndim == 2 else image[:, :, ::-1]
    # Noise repeats itself nowhere: against zlib's search for repetitions, matching runs alone takes half the time, and
    # files come out 1 to 15 % smaller (14 kinds of sensors).
    options = [cv2.IMWRITE_PNG_COMPRESSION, _COMPRESSION, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    return bytes(cv2.imencode(".png", np.ascontiguousarray(stored), options)[1])


def read_png(path: Path) -> Raster:
    """The image in a PNG file, as it was given to `encode_png`.

    InputError where it is missing, is no PNG, is truncated or damaged (each chunk's checksum is tested), or holds
    something other than grey or RGB.
    """
    import cv2

    try:
        data = read_file(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    check_picture(data, str(path), ("PNG",))  # OpenCV fills a truncated image up with black
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{path}: OpenCV cannot decode this PNG; the file is damaged")
    if image.ndim == 3 and image.shape[2] != 3:
        raise InputError(f"{path}: has {image.shape[2]} channels; allowed are 1 (grey) and 3 (RGB)")
    return np.ascontiguousarray(image if image.ndim == 2 else image[:, :, ::-1])
