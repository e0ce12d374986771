"""The rest map: what the lights of a scene do not explain of a real sensor's picture at rest, as factors of the signal.

It belongs to the image and not to the gel: it stays where it is when the gel moves. In a picture of 8 or 16 bits, half
of the range is a factor of 1, so that factors reach up to 2.
"""

from pathlib import Path

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.render.bitmap import decoded
from synth.scene import Camera, FurtherCamera


def read_rest_map(camera: Camera, folder: Path) -> FloatArray | float:
    """A camera's rest map (H, W, 3 or 1) float64 from its file in a folder; 1 for a camera that has none.

    InputError for no picture, one of another size than the camera's, and factors that are negative or not finite.
    """
    if camera.rest_map is None:
        return 1.0
    name = f"further_cameras.{camera.name}" if isinstance(camera, FurtherCamera) else "camera"
    path, where = folder / camera.rest_map, f"sensor.{name}.rest_map"
    stored = np.atleast_3d(decoded(path, where, (np.uint8, np.uint16, np.float32)))[:, :, 2::-1]
    height, width = stored.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f"{where}: {path} has {width} x {height} pixels, the camera has {camera.width} x {camera.height}; "
            "make the map from frames of the camera's size, or scale it"
        )
    one = 1 if stored.dtype == np.float32 else np.iinfo(stored.dtype).max // 2 + 1
    factors = stored.astype(np.float64) / one
    if not (np.isfinite(factors).all() and (factors >= 0).all()):
        raise InputError(f"{where}: {path} holds factors that are negative or not finite; allowed are 0 and above")
    return factors
