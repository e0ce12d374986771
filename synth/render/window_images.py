r"""Light that the window's outer face throws back onto the gel, by the method of images.

The face z = Z is a plane, so a path that it reflects is a straight one in the space behind it that holds a mirror image
of the gel and of every light: z becomes 2 Z - z. On its way through the plane light is weakened to Fresnel's internal
reflectance for unpolarised light,

.. math::  R(\theta) = F(\cos\theta, 1 / n), \qquad R = 1 \text{ for } \sin\theta \ge 1 / n .

That is exact for any number of reflections, and images of lights are sampled like lights: no path has to hit a small
one by chance.
"""

from typing import Any

import numpy as np

from synth.optics import Optics
from synth.optics.window import Window
from synth.render.gel_mesh import mirrored
from synth.scene import Light, Sensor


def reflecting_plane(sensor: Sensor) -> float | None:
    """Z (mm) of the window's outer face; None where it does not refract, or is round and reflects nothing here."""
    window = Optics.of(sensor).window
    return window.face_z if isinstance(window, Window) and window.index != 1 else None


def image_lights(sensor: Sensor) -> tuple[Light, ...]:
    """The lights' mirror images behind the window's outer face; none where it reflects nothing."""
    plane = reflecting_plane(sensor)
    return () if plane is None else tuple(_image(light, plane) for light in sensor.lights)


def all_lights(sensor: Sensor) -> tuple[Light, ...]:
    """What shines: the lights, then their mirror images."""
    return tuple(light for light in (*sensor.lights, *image_lights(sensor)) if light.power > 0)


def reflectance(cosine: Any, index: Any, mi: Any) -> Any:
    """R (mi.Float) of the body's outer face for light from inside, from cos θ >= 0."""
    return mi.fresnel(cosine, 1 / index)[0]


def _image(light: Light, face_z: float) -> Light:
    behind = mirrored(np.array([light.position_mm, light.aim_mm]), face_z)
    return light.model_copy(update={"position_mm": tuple(behind[0]), "aim_mm": tuple(behind[1])})
