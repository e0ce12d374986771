"""The LEDs: rectangular area emitters inside the index-matched body of gel and window, or in the air of a round one.

Their light goes straight to the gel: the face at which the camera's rays bend takes no part in the lighting.

A rectangle emits to one side, Lambertian ones through Mitsuba's area emitters, narrower ones through `Narrow`.
Its first size runs parallel to the contact face, its second at right angles to it and to the viewing direction; a light
that shines straight down has its first size along x. Its back is black.
"""

from functools import cache
from itertools import product
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.optics import Optics
from synth.render.gel_mesh import MIRROR
from synth.scene import Light, Sensor, Vector3

NARROW = "synth_narrow"
"""Name of `Narrow` among Mitsuba's plugins."""


def emitters(lights: tuple[Light, ...], mi: Any) -> dict[str, Any]:
    """Mitsuba's description of all lights that shine, in the renderer's frame."""
    shapes = {}
    for i, light in enumerate(lights):
        if light.power == 0:
            continue
        frame = np.eye(4)
        frame[:3, :3] = light_axes(light).T * [light.size_mm[0] / 2, light.size_mm[1] / 2, 1.0]
        frame[:3, 3] = light.position_mm
        # Mirroring alone would make the frame left-handed and turn the rectangle's normal: negate its first axis too.
        frame[:3] *= MIRROR[:, None]
        frame[:3, 0] *= -1
        emitter: dict[str, Any] = {"type": "area"}
        if light.narrowness:
            _register(mi.variant())
            emitter = {"type": NARROW, "narrowness": light.narrowness}
        shapes[f"light{i}"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f(frame.tolist()),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
            "emitter": {**emitter, "radiance": {"type": "rgb", "value": list(light.radiance)}},
        }
    return shapes


def light_axes(light: Light) -> FloatArray:
    """Unit vectors (3, 3) float64 along a light's first size, its second size and its direction, in the scene's frame.

    Raises:
        InputError: position_mm and aim_mm are the same point.
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
    optics, camera = Optics.of(sensor), sensor.camera
    across = np.linspace(-0.5, 0.5, 33)
    u, v = (axis.ravel() for axis in np.meshgrid(across, across))
    for i, light in enumerate(sensor.lights):
        first, second, _ = light_axes(light)
        points = (
            np.array(light.position_mm) + np.outer(u * light.size_mm[0], first) + np.outer(v * light.size_mm[1], second)
        )
        pixels = optics.project(points[optics.window.shows(points)])
        inside = ((pixels > 0) & (pixels < [camera.width, camera.height])).all(1)
        if inside.any():
            x, y = pixels[inside][0]
            raise InputError(
                f"sensor.lights[{i}] at position_mm = {list(light.position_mm)} stands between the camera and the gel "
                f"(at pixel {x:.0f}, {y:.0f}): move it out of the camera's view"
            )


def reaches(light: Light, size_mm: Vector3) -> bool:
    """Whether a light shines, and not away from all of a box twice as long as the gel, in which its surface moves."""
    corners = np.array(list(product((-1, 1), repeat=3))) * size_mm - light.position_mm
    return light.power > 0 and bool(np.any(corners @ np.subtract(light.aim_mm, light.position_mm) > 0))


@cache
def _register(variant: str) -> None:
    """Once for each variant: Mitsuba's base classes differ between them. `variant` is the loaded one."""
    import drjit as dr
    import mitsuba as mi

    class Narrow(mi.Emitter):
        """An area that emits cos^k θ of its radiance along its normal; no rays start from it."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            color = mi.Spectrum(*list(properties["radiance"])[: len(mi.Spectrum(0))])  # a mono variant's is grey
            self._radiance, self._narrowness = color, mi.Float(properties["narrowness"])
            dr.make_opaque(self._radiance, self._narrowness)
            self.m_flags = +mi.EmitterFlags.Surface

        def eval(self, interaction: Any, active: Any = True) -> Any:
            return self._toward(mi.Frame3f.cos_theta(interaction.wi), active)

        def sample_direction(self, reference: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
            found = self.get_shape().sample_direction(reference, sample, active)
            found.emitter = mi.EmitterPtr(self) if dr.is_jit_v(mi.Float) else self
            return found, dr.select(found.pdf > 0, self.eval_direction(reference, found, active) / found.pdf, 0)

        def pdf_direction(self, reference: Any, found: Any, active: Any = True) -> Any:
            faces = dr.dot(found.d, found.n) < 0
            return dr.select(faces, self.get_shape().pdf_direction(reference, found, active), 0)

        def eval_direction(self, reference: Any, found: Any, active: Any = True) -> Any:
            return self._toward(-dr.dot(found.d, found.n), active)

        def _toward(self, cosine: Any, active: Any) -> Any:
            share = dr.power(dr.maximum(cosine, 0), self._narrowness)
            return dr.select(active & (cosine > 0), self._radiance * share, 0)

        def traverse(self, callback: Any) -> None:
            """No parameters: the lights go in with the scene."""

    mi.register_emitter(NARROW, Narrow)
