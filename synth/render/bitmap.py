"""A picture of the user's own as a pattern: read, and laid on the texels of the contact face.

It is stored in sRGB (IEC 61966-2-1) and decoded to linear values before anything is averaged,

    c = s / 12.92 for s <= 0.04045,   c = ((s + 0.055) / 1.055)^2.4 above,

with the opacity multiplied in. A picture finer than the texture is first averaged over areas of one texel, so that fine
detail becomes its mean; then it is interpolated linearly at the texels' centres.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray, Image
from synth.errors import InputError
from synth.render.chart import texture_coordinates
from synth.scene import Bitmap, Sensor
from synth.untrusted import check_picture, read_file

MOST_PIXELS = 2**25
"""Of a picture, such as 8192 x 4096; in linear light each takes some 50 bytes."""


def painted(
    pattern: Bitmap, sensor: Sensor, folder: Path, x: FloatArray, y: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Colours, and the share of each texel that is painted, as `laid_over` gives them; texel centres x and y are even.

    Files are relative to the folder; InputError as for `read_picture` and `texture_coordinates`.
    """
    picture = read_picture(pattern, folder)
    if pattern.placing == "uv":
        u, v = np.moveaxis(texture_coordinates(sensor, folder, x, y), 2, 0)
        return laid_over(picture, u, 1 - v, np.isfinite(u).astype(float))
    return laid_over(picture, *_placed(pattern, picture.shape[0] / picture.shape[1], x, y))


def read_picture(pattern: Bitmap, folder: Path) -> Image:
    """The picture in linear light, (h, w, 4) float32 in [0, 1], from its file in a folder.

    Red, green and blue, each multiplied by the opacity, and the opacity. InputError where there is no such file, or no
    picture of 8 or 16 bits that OpenCV can read.
    """
    stored = decoded(folder / pattern.file, "sensor.pattern.file", (np.uint8, np.uint16))
    values: Image = stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
    opacity = values[:, :, 3:] if values.shape[2] == 4 else np.ones((*values.shape[:2], 1), np.float32)
    return np.concatenate([_linear(values[:, :, 2::-1]) * opacity, opacity], axis=2)


def decoded(path: Path, where: str, kinds: tuple[type, ...]) -> NDArray[Any]:
    """A picture as it is stored, (h, w, 3) in the order BGR, (h, w, 4) with opacity or (h, w) floats; of these dtypes.

    InputError, which names `where`, for no such file, and for none that OpenCV can read.
    """
    import cv2

    try:
        data = read_file(path)
    except OSError as error:
        raise InputError(f"{where}: {path} cannot be read: {error.strerror or error}") from error
    check_picture(data, f"{where}: {path}", most=MOST_PIXELS)
    try:
        stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if stored is not None and stored.dtype != np.float32 and stored.shape[2:] != (4,):  # turned as EXIF says
            stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        stored = None
    if stored is None or stored.dtype not in kinds:
        raise InputError(f"{where}: {path} is no whole picture of 8 or 16 bits that OpenCV can read; save it as PNG")
    return stored


def _placed(pattern: Bitmap, tall: float, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places for `laid_over` of a picture that is `tall` times as high as wide; texel centres x and y are even."""
    width_mm, texel = pattern.width_mm or 0.0, max(x[1] - x[0], y[1] - y[0])
    angle = np.radians(pattern.rotation_deg)
    dx, dy = x[None] - pattern.offset_mm[0], y[:, None] - pattern.offset_mm[1]
    across, down = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
    inside = np.minimum(width_mm / 2 - np.abs(across), tall * width_mm / 2 - np.abs(down))
    return across / width_mm + 0.5, down / (tall * width_mm) + 0.5, np.clip(inside / texel + 0.5, 0, 1)


def laid_over(
    picture: Image, across: FloatArray, down: FloatArray, inside: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What a picture puts on texels, by their places across and down it, each 0 to 1, and their shares inside it.

    Colours (rows, columns, 3), linear, and the share of each texel that is painted (rows, columns). Where nothing is,
    the colour is the picture's mean, so that interpolated edges have no fringe. Places may be NaN where nothing is.
    """
    import cv2
    from scipy.ndimage import map_coordinates

    sides, places = picture.shape[1::-1], (across, down)
    steps = [float(np.nanmedian(np.hypot(*np.gradient(place)))) for place in places]  # of the picture, per texel
    wanted = [max(1, min(side, round(1 / step))) for side, step in zip(sides, steps, strict=True)]
    coarse = cv2.resize(picture, wanted, interpolation=cv2.INTER_AREA)
    at = [np.nan_to_num(place) * count - 0.5 for place, count in zip(places, wanted, strict=True)][::-1]
    values = [map_coordinates(coarse[:, :, k], at, output=np.float64, order=1, mode="nearest") for k in range(4)]
    painted = values[3] * inside
    total = picture.sum(axis=(0, 1), dtype=np.float64)
    colors = np.broadcast_to(total[:3] / max(total[3], 1.0), (*painted.shape, 3)).copy()
    seen = values[3] > 1e-6
    colors[seen] = np.stack(values[:3], axis=-1)[seen] / values[3][seen, None]
    return colors, painted


def _linear(values: Image) -> Image:
    low = values / np.float32(12.92)
    return np.where(values <= 0.04045, low, ((values + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4))
