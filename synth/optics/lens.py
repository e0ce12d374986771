"""What every lens model does, in the camera's own frame: x right, y down, z forward."""

import numpy as np

from synth.optics.lens_fisheye import FisheyeLens
from synth.optics.lens_pinhole import PinholeLens
from synth.scene import Camera

Lens = PinholeLens | FisheyeLens
"""A one-to-one map between directions and pixels within the lens's field; both are NaN beyond it."""


def lens_of(camera: Camera) -> Lens:
    kind = FisheyeLens if camera.lens == "fisheye" else PinholeLens
    return kind(np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy]), camera.distortion)
