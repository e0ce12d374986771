r"""The LEDs: rectangular area emitters inside the index-matched body of gel and window, or in the air of a round one.

Their light goes straight to the gel: the face at which the camera's rays bend takes no part in the lighting.

A rectangle emits to one side (`synth.scene.Light.radiance`); its back is black. Its first size runs parallel to the
contact face, its second at right angles to it and to its direction; a light that shines straight down has its first
size along x.

Light that the window's outer face throws back onto the gel is found by the method of images. The face z = Z is a plane,
so a path that it reflects is a straight one in the space behind it that holds a mirror image of the gel and of every
light: z becomes 2 Z - z. On its way through the plane light is weakened to Fresnel's internal reflectance for
unpolarised light,

.. math::  R(\theta) = F(\cos\theta, 1 / n), \qquad R = 1 \text{ for } \sin\theta \ge 1 / n .

That is exact for any number of reflections, and images of lights are sampled like lights: no path has to hit a small
one by chance.
"""

import math
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray, Points
from synth.errors import InputError
from synth.optics import Optics
from synth.optics.window import Window
from synth.render.gel_mesh import MIRROR, mirrored
from synth.scene import Light, Sensor, Vector3

ACROSS = 32


def emitters(lights: tuple[Light, ...], mi: Any) -> dict[str, Any]:
    """Mitsuba's description of all lights that shine, in the renderer's frame, for scalar variants."""
    shapes = {}
    black = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}})
    for i, (light, (corner, first, second, direction)) in enumerate(zip(lights, rectangles(lights), strict=True)):
        if light.power == 0:
            continue
        frame = np.eye(4)
        # Mirrored axes alone would make a left-handed frame and turn the rectangle's normal: the first is negated, too.
        frame[:3] = np.column_stack([-first / 2, second / 2, direction, corner + (first + second) / 2])
        shapes[f"light{i}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(frame.tolist()),
            "bsdf": black,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(light.radiance)}},
        }
    return shapes


def panels(lights: tuple[Light, ...], mi: Any) -> Any:
    """One mesh of rectangles, two triangles each, for vectorised variants: black, as Mitsuba knows no light in it."""
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(lights))[:, None, None]
    shape = mi.Mesh("lights", 4 * len(lights), 2 * len(lights))
    parameters = mi.traverse(shape)
    parameters["faces"] = faces.ravel().astype(np.uint32)
    parameters["vertex_positions"] = panel_corners(lights)
    parameters.update()
    return shape


def panel_corners(lights: tuple[Light, ...]) -> NDArray[np.float32]:
    """(12 n,) the vertices of `panels`: four corners of each light, in the renderer's frame."""
    corner, first, second, _ = rectangles(lights).swapaxes(0, 1)
    corners = np.stack([corner, corner + first, corner + first + second, corner + second], axis=1)
    return corners.ravel().astype(np.float32)


def rectangles(lights: tuple[Light, ...]) -> FloatArray:
    """(n, 4, 3) of each light a corner, its two sides and its direction (unit), in the renderer's frame."""
    found = np.empty((len(lights), 4, 3))
    for light, (corner, *sides, direction) in zip(lights, found, strict=True):
        *axes, direction[:] = light_axes(light)
        for side, axis, size in zip(sides, axes, light.size_mm, strict=True):
            side[:] = size * axis
        corner[:] = np.array(light.position_mm) - sides[0] / 2 - sides[1] / 2
    return found * MIRROR


def light_axes(light: Light) -> FloatArray:
    """Unit vectors (3, 3) float64 along a light's first size, its second size and its direction, in the scene's frame.

    InputError where position_mm and aim_mm are the same point.
    """
    direction = np.array(light.aim_mm) - np.array(light.position_mm)
    distance = np.linalg.norm(direction)
    if distance < 1e-9:
        raise InputError(f"a light at position_mm = {list(light.position_mm)} aims at itself: move its aim_mm")
    direction /= distance
    first = np.cross([0.0, 0.0, 1.0], direction)
    first = first / np.linalg.norm(first) if np.linalg.norm(first) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return np.stack([first, np.cross(direction, first), direction])


def check_view(sensor: Sensor) -> None:
    """Refuse lights that the camera would see: they would hide gel that the flow says is visible."""
    optics = Optics.of(sensor)
    lit = [_places(light) for light in sensor.lights]
    points = np.concatenate([np.zeros((0, 3)), *lit])
    numbers = np.repeat(np.arange(len(lit)), [len(places) for places in lit])
    shown = optics.window.shows(points)
    pixels = optics.project(points[shown])
    inside = optics.is_inside(pixels)
    if inside.any():
        i, (x, y) = numbers[shown][inside][0], pixels[inside][0]
        raise InputError(
            f"sensor.lights[{i}] at position_mm = {list(sensor.lights[i].position_mm)} stands between the camera and "
            f"the gel (at pixel {x:.0f}, {y:.0f}): move it out of the camera's view, or check that fx, fy, cx and cy "
            "are in pixels of this width and height"
        )


def _places(light: Light) -> Points:
    """(n, 3) places on a light: ACROSS steps along its longer side, and as long ones along the other."""
    first, second, _ = light_axes(light)
    step = max(light.size_mm) / ACROSS
    sides = (np.linspace(-size / 2, size / 2, 1 + math.ceil(size / step)) for size in light.size_mm)
    u, v = (axis.ravel() for axis in np.meshgrid(*sides))
    return np.asarray(light.position_mm + np.outer(u, first) + np.outer(v, second))


def reaches(light: Light, size_mm: Vector3) -> bool:
    """Whether a light shines, and not away from all of a box twice as long as the gel, in which its surface moves."""
    corners = np.array(list(product((-1, 1), repeat=3))) * size_mm - light.position_mm
    return light.power > 0 and bool(np.any(corners @ np.subtract(light.aim_mm, light.position_mm) > 0))


def reflecting_plane(sensor: Sensor) -> float | None:
    """Z (mm) of the window's outer face; None where it does not refract, or is round and reflects nothing here."""
    window = Optics.of(sensor).window
    return window.face_z if isinstance(window, Window) and window.index != 1 else None


def image_lights(sensor: Sensor) -> tuple[Light, ...]:
    """The lights' mirror images behind the window's outer face; none where it reflects nothing."""
    plane = reflecting_plane(sensor)
    return () if plane is None else tuple(_image(light, plane) for light in sensor.lights)


def all_lights(sensor: Sensor) -> tuple[Light, ...]:
    """The lights with power, and their mirror images behind a window that reflects."""
    return tuple(light for light in (*sensor.lights, *image_lights(sensor)) if light.power > 0)


def reflectance(cosine: Any, index: Any, mi: Any) -> Any:
    """R (mi.Float) of the body's outer face for light from inside, from cos θ >= 0."""
    return mi.fresnel(cosine, 1 / index)[0]


def _image(light: Light, face_z: float) -> Light:
    behind = mirrored(np.array([light.position_mm, light.aim_mm]), face_z)
    return light.model_copy(update={"position_mm": tuple(behind[0]), "aim_mm": tuple(behind[1])})
