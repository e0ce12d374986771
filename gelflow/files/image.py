"""Images: PNG, TIFF or PPM (8 or 16 bit, grey or colour, with or without alpha) and 8-bit JPEG or BMP.

In memory an image is (H, W, 3) float32, RGB in [0, 1]: a grey image has three equal channels, alpha is dropped, and a
photograph is turned as its EXIF data say.
"""

import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, UnidentifiedImageError

from gelflow.arrays import Bytes3, Grey8, ImageArray
from gelflow.errors import InputError
from gelflow.files.atomic import replacing
from gelflow.files.quiet import quiet
from gelflow.untrusted import MOST_PIXELS, read_file

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm"})
FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM")
MINIMUM_SIDE = 16
"""Optical flow of an image with a side of fewer px is not attempted."""


def _check(path: Path, data: bytes) -> None:
    """Refuses what OpenCV decodes, as far as it goes, without complaint: PNGs by checksums, others by decoding."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data), formats=FORMATS) as image:
            if image.width * image.height > MOST_PIXELS:
                raise ValueError(f"{image.width} x {image.height} px; at most {MOST_PIXELS} px are read")
            if image.format == "PNG":
                image.verify()
            else:
                image.load()
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: not an image; allowed: {', '.join(FORMATS)}") from error
    except Exception as error:  # of whatever kind a damaged header causes
        raise InputError(f"{path}: truncated or damaged image ({error})") from error


def read_image(path: Path) -> ImageArray:
    """An image as (H, W, 3) float32, RGB in [0, 1]; InputError if missing, damaged, or neither of 8 nor 16 bits."""
    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if Path(str(path)).is_dir() else 'there is no such image file'}")
    data = read_file(path) if isinstance(path, Path) else path.read_bytes()
    _check(path, data)
    with quiet():
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if pixels is None:
        raise InputError(f"{path}: the image does not decode")
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: {pixels.dtype} pixels; allowed: 8 or 16 bits per channel")
    largest = np.iinfo(pixels.dtype).max
    return np.ascontiguousarray(pixels[..., ::-1], np.float32) / np.float32(largest)


def read_pair(path1: Path, path2: Path) -> tuple[ImageArray, ImageArray]:
    """Two images; InputError where one cannot be read or is smaller than `MINIMUM_SIDE`, or their sizes differ."""
    image1, image2 = read_image(path1), read_image(path2)
    size1, size2 = (f"{image.shape[1]} x {image.shape[0]} px" for image in (image1, image2))
    for path, image, size in ((path1, image1, size1), (path2, image2, size2)):
        if min(image.shape[:2]) < MINIMUM_SIDE:
            raise InputError(f"{path}: {size} are too few for optical flow; each side needs {MINIMUM_SIDE} px or more")
    if image1.shape != image2.shape:
        raise InputError(f"{path1} has {size1}, {path2} has {size2}; both images of a pair need one size")
    return image1, image2


def to_bytes(image: ImageArray) -> Bytes3:
    """An image in [0, 1] as (H, W, 3) uint8, rounded to nearest; values outside are clipped."""
    return np.clip(np.rint(image * 255.0), 0, 255).astype(np.uint8)


def to_grey(image: ImageArray) -> Grey8:
    """Luma of an image as (H, W) uint8: round(.299 R + .587 G + .114 B) of its 8-bit channels (ITU-R BT.601)."""
    return cv2.cvtColor(to_bytes(image), cv2.COLOR_RGB2GRAY)


def write_png(path: Path, pixels: Bytes3 | Grey8) -> None:
    """Writes (H, W, 3) RGB or (H, W) grey uint8 as PNG; replaces the file as a whole."""
    bgr = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    data = cv2.imencode(".png", np.ascontiguousarray(bgr))[1]
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())
