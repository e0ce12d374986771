"""A picture of the user's own as reflectance over the contact face.

Stored values are sRGB (IEC 61966-2-1) and are decoded to linear ones before anything is averaged,

    c = s / 12.92 for s <= 0.04045,   c = ((s + 0.055) / 1.055)^2.4 above,

with the opacity multiplied in. A picture finer than the texture is first averaged over areas of one texel, so that fine
detail becomes its mean; then it is interpolated linearly at the texels' centres.
"""

from pathlib import Path

import numpy as np

from synth.arrays import FloatArray, Image
from synth.errors import InputError
from synth.scene import Bitmap


def read_picture(pattern: Bitmap, folder: Path) -> Image:
    """The picture in linear light, from its file in a folder.

    Returns:
        (h, w, 4) float32 in [0, 1]: red, green, blue, each multiplied by the opacity, and the opacity.

    Raises:
        InputError: no such file, or no picture of 8 or 16 bits that OpenCV can read.
    """
    import cv2

    path = folder / pattern.file
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"sensor.pattern.file: {path} cannot be read: {error.strerror or error}") from error
    try:
        stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if stored is not None and stored.shape[2:] != (4,):  # no opacity: turned as EXIF says, three channels
            stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:  # an empty file, or one of absurd size
        stored = None
    if stored is None or stored.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"sensor.pattern.file: {path} is no whole picture of 8 or 16 bits that OpenCV can read; save it as PNG"
        )
    values = stored.astype(np.float32) / np.iinfo(stored.dtype).max
    opacity = values[:, :, 3:] if values.shape[2] == 4 else np.ones((*values.shape[:2], 1), np.float32)
    return np.concatenate([_linear(values[:, :, 2::-1]) * opacity, opacity], axis=2)


def laid_over(pattern: Bitmap, picture: Image, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What a picture puts on the face, at texel centres x (columns,) and y (rows,) mm, both even.

    Returns:
        Colours (rows, columns, 3), linear, and the share of each texel that is painted (rows, columns). Where nothing
        is, the colour is the picture's mean, so that interpolated edges have no fringe.
    """
    import cv2
    from scipy.ndimage import map_coordinates

    rows, columns = picture.shape[:2]
    height_mm = pattern.width_mm * rows / columns
    texel = max(x[1] - x[0], y[1] - y[0])
    wanted = (max(1, min(columns, round(pattern.width_mm / texel))), max(1, min(rows, round(height_mm / texel))))
    coarse = cv2.resize(picture, wanted, interpolation=cv2.INTER_AREA)
    angle = np.radians(pattern.rotation_deg)
    dx, dy = x[None] - pattern.offset_mm[0], y[:, None] - pattern.offset_mm[1]
    across, down = dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)
    place = [(down / height_mm + 0.5) * wanted[1] - 0.5, (across / pattern.width_mm + 0.5) * wanted[0] - 0.5]
    values = [map_coordinates(coarse[:, :, k], place, output=np.float64, order=1, mode="nearest") for k in range(4)]
    inside = np.minimum(pattern.width_mm / 2 - np.abs(across), height_mm / 2 - np.abs(down))
    painted = values[3] * np.clip(inside / texel + 0.5, 0, 1)
    total = picture.sum(axis=(0, 1), dtype=np.float64)
    colors = np.broadcast_to(total[:3] / max(total[3], 1.0), (*painted.shape, 3)).copy()
    seen = values[3] > 1e-6
    colors[seen] = np.stack(values[:3], axis=-1)[seen] / values[3][seen, None]
    return colors, painted


def _linear(values: Image) -> Image:
    low = values / np.float32(12.92)
    return np.where(values <= 0.04045, low, ((values + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4))
