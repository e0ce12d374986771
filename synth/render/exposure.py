"""Whether light suits the camera: what is clipped, dark or flat in a picture, and by what factor to change light.

Levels are shares of white. Rule of thumb: the brightest per cent of the gel lies at 85 % of white.
"""

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Image
from synth.render.camera_image import expected_signal
from synth.scene import Camera

AIM, DARK = 0.85, 0.05
"""Level of the rule of thumb; level below which pixels are dark."""
MOST_BLIND, LEAST_BRIGHT, LEAST_SPREAD = 0.04, 0.4, 0.02
"""Beyond these light is amiss: share of blind pixels, level of the brightest per cent, standard deviation of levels."""
AROUND = 20
"""Side of the square in which most pixels around a blind one are white: the picture's longest over this number."""

Levels = dict[str, dict[str, float]]
"""By channel: mean, spread (standard deviation), bright (where the brightest per cent begins); and the shares of pixels
at white (clipped), that are dark, and in white areas (blind), where no motion is seen. White dots are no such areas."""


def levels_of(image: NDArray[np.uint8] | NDArray[np.uint16], gel: BoolArray) -> Levels:
    """The levels of an image (H, W) or (H, W, 3) where pixels (H, W) show gel: at least one."""
    import cv2

    found, side = {}, max(3, max(image.shape) // AROUND)
    for k, name in enumerate(("grey",) if image.ndim == 2 else ("red", "green", "blue")):
        level = image.reshape(*gel.shape, -1)[:, :, k] / np.float32(np.iinfo(image.dtype).max)
        shown, around = level[gel], cv2.blur((level == 1).astype(np.float32), (side, side))[gel]
        one = {"mean": shown.mean(), "spread": shown.std(), "bright": np.percentile(shown, 99)}
        one |= {"clipped": (shown == 1).mean(), "dark": (shown < DARK).mean(), "blind": (around > 0.5).mean()}
        found[name] = {key: round(float(value), 4) for key, value in one.items()}
    return found


def advice(levels: Levels, radiance: Image, gel: BoolArray, camera: Camera, rest_map: FloatArray | float = 1.0) -> str:
    """What is wrong with a picture's light, and what to do about it; empty where nothing is.

    The radiance (H, W, C) is not clipped, so that the factor holds for any light.
    """
    worst = max(levels, key=lambda name: levels[name]["blind"])
    bright, spread = (max(one[key] for one in levels.values()) for key in ("bright", "spread"))
    if levels[worst]["blind"] > MOST_BLIND:
        trouble = f"clipped: {100 * levels[worst]['clipped']:.0f} % of the gel's pixels are at white in {worst}"
    elif bright < LEAST_BRIGHT:
        trouble = f"dark: the brightest per cent of the gel's pixels is at {100 * bright:.0f} % of white"
    elif spread < LEAST_SPREAD:
        return (
            f"flat: levels on the gel spread by {100 * spread:.1f} % of white; check aims of sensor.lights, and pattern"
        )
    else:
        return ""
    peak = float(np.percentile(expected_signal(radiance, camera, rest_map)[gel], 99, axis=0).max())
    if peak == 0:
        return "dark: no light reaches the gel that the camera sees; check places and aims of sensor.lights"
    factor = AIM**camera.gamma / peak
    return (
        f"{trouble}; multiply the power of all sensor.lights by {factor:.3g}, or give --set sensor.camera.exposure="
        f"{factor * camera.exposure:.3g}: the brightest per cent is then at {100 * AIM:.0f} % of white"
    )
