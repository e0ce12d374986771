r"""Light that the window's outer face throws back onto the gel, by the method of images.

The face z = Z is a plane, so a path that it reflects is a straight one in the space behind it that holds a mirror image
of the gel and of every light: z becomes 2 Z - z. On its way through the plane light is weakened to Fresnel's internal
reflectance for unpolarised light,

.. math::  R(\theta) = F(\cos\theta, 1 / n), \qquad R = 1 \text{ for } \sin\theta \ge 1 / n .

That is exact for any number of reflections, and images of lights are sampled like lights: no path has to hit a small
one by chance. A path tracer sees the plane as a surface that lets R pass undeflected (`Pane`).
"""

from functools import cache
from typing import Any

import numpy as np

from synth.optics import Optics
from synth.optics.window import Window
from synth.render.gel_mesh import mirrored
from synth.scene import Light, Sensor

PANE = "synth_pane"
"""Name of `Pane` among Mitsuba's plugins."""
_WIDE = 1e3
"""Half width of the plane, mm: wider than any sensor."""


def reflecting_plane(sensor: Sensor) -> float | None:
    """Z (mm) of the window's outer face; None where it does not refract, or is round and reflects nothing here."""
    window = Optics.of(sensor).window
    return window.face_z if isinstance(window, Window) and window.index != 1 else None


def image_lights(sensor: Sensor) -> tuple[Light, ...]:
    """The lights' mirror images behind the window's outer face; none where it reflects nothing."""
    plane = reflecting_plane(sensor)
    return () if plane is None else tuple(_image(light, plane) for light in sensor.lights)


def reflectance(cosine: Any, index: Any, mi: Any) -> Any:
    """R (mi.Float) of the body's outer face for light from inside, from cos θ >= 0."""
    return mi.fresnel(cosine, 1 / index)[0]


def pane(sensor: Sensor, mi: Any) -> dict[str, Any]:
    """Mitsuba's description of the outer face, for paths that go on among the images."""
    _register(mi.variant())
    transform, index = mi.ScalarTransform4f, sensor.window.refractive_index
    place = transform().translate([0, 0, reflecting_plane(sensor)]) @ transform().scale([_WIDE, _WIDE, 1])
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": PANE, "index": index}}


def _image(light: Light, face_z: float) -> Light:
    behind = mirrored(np.array([light.position_mm, light.aim_mm]), face_z)
    return light.model_copy(update={"position_mm": tuple(behind[0]), "aim_mm": tuple(behind[1])})


@cache
def _register(variant: str) -> None:
    """Once for each variant: Mitsuba's base classes differ between them. `variant` is the loaded one."""
    import mitsuba as mi

    class Pane(mi.BSDF):
        """Lets R of the light pass undeflected, and nothing else."""

        def __init__(self, properties: Any) -> None:
            import drjit as dr

            super().__init__(properties)
            self._index = dr.opaque(mi.Float, properties["index"])
            self.m_components = [mi.BSDFFlags.Null | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide]
            self.m_flags = self.m_components[0]

        def sample(self, context: Any, interaction: Any, one: Any, two: Any, active: Any) -> tuple[Any, Any]:
            import drjit as dr

            sample = dr.zeros(mi.BSDFSample3f)
            sample.wo, sample.pdf, sample.eta = -interaction.wi, 1, 1
            sample.sampled_type = mi.UInt32(+mi.BSDFFlags.Null)
            return sample, self.eval_null_transmission(interaction, active)

        def eval(self, context: Any, interaction: Any, outgoing: Any, active: Any) -> Any:
            return mi.Spectrum(0)

        def pdf(self, context: Any, interaction: Any, outgoing: Any, active: Any) -> Any:
            return mi.Float(0)

        def eval_pdf(self, context: Any, interaction: Any, outgoing: Any, active: Any) -> tuple[Any, Any]:
            return mi.Spectrum(0), mi.Float(0)

        def eval_null_transmission(self, interaction: Any, active: Any) -> Any:
            import drjit as dr

            return mi.Spectrum(reflectance(dr.abs(mi.Frame3f.cos_theta(interaction.wi)), self._index, mi))

        def traverse(self, callback: Any) -> None:
            """No parameters: the index goes in with the scene."""

    mi.register_bsdf(PANE, Pane)
