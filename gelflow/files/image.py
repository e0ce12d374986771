"""Images: PNG, TIFF or PPM (8 or 16 bit, grey or colour, with or without alpha) and 8-bit JPEG or BMP.

In memory an image is (H, W, 3) float32, RGB in [0, 1]: a grey image has three equal channels, alpha is dropped, and a
photograph is turned as its EXIF data say.
"""

import io
import math
import warnings
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gelflow.arrays import Bytes3, Frame, Grey8, ImageArray
from gelflow.errors import InputError
from gelflow.files.atomic import replacing
from gelflow.files.quiet import quiet
from gelflow.untrusted import MOST_PIXELS, read_file

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm"})
FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "PPM")
MINIMUM_SIDE = 16
"""Optical flow of an image with a side of fewer px is not attempted."""
SMALL_RANGE = 0.25
"""Images whose largest value, white being 1, is at most this have fewer bits than their file, or hardly any light."""


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


def read_pixels(path: Path) -> Frame:
    """An image as (H, W, 3), RGB; InputError if missing, damaged, or neither of 8 nor 16 bits."""
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
    return np.ascontiguousarray(pixels[..., ::-1])


def read_image(path: Path) -> ImageArray:
    """An image as (H, W, 3) float32, RGB in [0, 1]; exceptions as for `read_pixels`."""
    return in_unit_range(read_pixels(path))


def in_unit_range(frame: Frame) -> ImageArray:
    """Pixels as float32, white of 8 or 16 bits as 1."""
    return frame.astype(np.float32) / np.float32(np.iinfo(frame.dtype).max)


THREE_OF = {1: [0, 0, 0], 4: [0, 1, 2]}
"""Channels that stand for red, green and blue in grey images and in those with alpha, by their number of channels."""


def as_image(name: str, array: NDArray[np.generic]) -> ImageArray:
    """A user's array, (H, W) or (H, W, 1, 3 or 4), uint8, uint16 or real in [0, 1], as images are in memory.

    InputError for other values; the shape is checked by `check_images`.
    """
    image = array[..., None] if array.ndim == 2 else array
    if image.ndim == 3 and image.shape[2] in THREE_OF:
        image = image[..., THREE_OF[image.shape[2]]]
    if image.dtype in (np.uint8, np.uint16):
        return in_unit_range(cast(Frame, image))
    if image.dtype.kind not in "biuf":
        raise InputError(f"{name} is {image.dtype}; allowed: real numbers")
    if image.size:
        check_range(name, str(image.dtype), float(image.min()), float(image.max()))
    return image.astype(np.float32)


def check_range(name: str, dtype: str, lowest: float, highest: float) -> None:
    """Refuses values that are none of an image."""
    if lowest < 0.0 or highest > 1.0:
        raise InputError(
            f"{name} is {dtype} with values from {lowest:g} to {highest:g}; allowed: values in [0, 1], or an array of "
            "uint8"
        )


def full_range(image1: ImageArray, image2: ImageArray) -> tuple[ImageArray, ImageArray]:
    """Both images times their `range_factor`."""
    factor = np.float32(range_factor(max(image1.max(initial=0.0), image2.max(initial=0.0))))
    return (image1, image2) if factor == 1 else (factor * image1, factor * image2)


def range_factor(largest: float) -> float:
    """The power of two by which images are multiplied that fill at most `SMALL_RANGE`; warns where it is not 1.

    `largest` is their largest value. 10 bits in files of 16 fill 1/64, and no method sees motion in so faint a picture.
    """
    if not 0 < largest <= SMALL_RANGE:
        return 1.0
    factor = 2 ** math.floor(-math.log2(largest))
    bits = 17 - factor.bit_length()
    warnings.warn(
        f"images that fill at most 1/{factor} of their range of values, such as {bits} bits in files of 16, are "
        f"multiplied by {factor}",
        stacklevel=2,
    )
    return float(factor)


def read_pair(path1: Path, path2: Path) -> tuple[ImageArray, ImageArray]:
    """Two images in `full_range`.

    InputError where one cannot be read or is smaller than `MINIMUM_SIDE`, or their sizes differ.
    """
    image1, image2 = read_image(path1), read_image(path2)
    size1, size2 = (f"{image.shape[1]} x {image.shape[0]} px" for image in (image1, image2))
    for path, image, size in ((path1, image1, size1), (path2, image2, size2)):
        if min(image.shape[:2]) < MINIMUM_SIDE:
            raise InputError(f"{path}: {size} are too few for optical flow; each side needs {MINIMUM_SIDE} px or more")
    if image1.shape != image2.shape:
        raise InputError(f"{path1} has {size1}, {path2} has {size2}; both images of a pair need one size")
    return full_range(image1, image2)


def check_images(image1: ImageArray, image2: ImageArray) -> None:
    """Refuses images that differ in shape, are not (H, W, 3), are too small, or hold values that are not finite."""
    for name, image in (("image 1", image1), ("image 2", image2)):
        if image.ndim != 3 or image.shape[2] != 3:
            raise InputError(f"{name} has shape {image.shape}; (rows, columns, 3) is needed, a grey image repeated")
        if min(image.shape[:2]) < MINIMUM_SIDE:
            raise InputError(f"{name} has {image.shape[1]} x {image.shape[0]} px; each side needs {MINIMUM_SIDE} px")
        if not np.isfinite(image).all():
            raise InputError(f"{name} holds NaN or infinite values; values in [0, 1] are needed")
    if image1.shape != image2.shape:
        raise InputError(f"image 1 has shape {image1.shape} and image 2 {image2.shape}; they must be equal")


def to_bytes(image: ImageArray) -> Bytes3:
    """An image in [0, 1] as (H, W, 3) uint8, rounded to nearest; values outside are clipped."""
    return np.clip(np.rint(image * 255.0), 0, 255).astype(np.uint8)


def shown(frame: Frame) -> Bytes3:
    """A frame in its `full_range`, with 8 bits."""
    image = in_unit_range(frame)
    return to_bytes(full_range(image, image)[0])


def to_grey(image: ImageArray) -> Grey8:
    """Luma of an image as (H, W) uint8: round(.299 R + .587 G + .114 B) of its 8-bit channels (ITU-R BT.601)."""
    return cv2.cvtColor(to_bytes(image), cv2.COLOR_RGB2GRAY)


def write_png(path: Path, pixels: Frame | Grey8) -> None:
    """Writes (H, W, 3) RGB of 8 or 16 bits or (H, W) grey uint8 as PNG; replaces the file as a whole."""
    bgr = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    data = cv2.imencode(".png", np.ascontiguousarray(bgr))[1]
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())
