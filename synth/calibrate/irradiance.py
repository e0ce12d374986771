r"""What each light alone contributes to the picture of the undeformed gel, differentiable in the lights' geometry.

The undeformed contact face is a plane that cannot light itself, so its radiance toward the camera is an integral over
each light's rectangle and nothing else. For a light of power 1 and colour white, with area A, at a point x of the face:

.. math::  E_i(x) = \frac{1 - F}{n^2} \int_A f(\omega_o, \omega) \cos\theta \, \max(\cos\theta', 0) \,
                    \frac{1}{\pi A} \frac{dA'}{|x' - x|^2}

with the coating's BSDF f (Mitsuba's), θ at the face and θ' at the light. It is evaluated by the midpoint rule on a
grid over the rectangle: no noise, and the same radiometry as the renderer's, with the shade that one light throws on
another. The light's mirror image behind the window adds its own integral (`synth.render.window_images`), without shade;
what the gel itself sends to the window and gets back is left out. Dr.Jit differentiates both with respect to the
lights' centres, directions and sizes, the shade held. Mitsuba's path integrators would as well, with Monte Carlo noise
in every step and for paths that an undeformed face has not.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Pixels
from synth.render.camera_rays import CameraRays
from synth.render.coating import coat
from synth.render.gel_mesh import MIRROR
from synth.render.variant import Variant
from synth.render.window_images import reflectance, reflecting_plane
from synth.scene import Sensor

_CELLS = 24
"""Midpoints on each light; its longer side gets more of them."""

_NUMBERS = (*((part, axis, float(MIRROR[axis])) for part in (0, 1) for axis in range(3)), (2, 0, 1.0), (2, 1, 1.0))
"""Of a light's 8 numbers: centre (0), direction (1) or size (2), which component, and its sign in the renderer."""


@dataclass(frozen=True, eq=False)
class LightGeometry:
    """Where lights are and how they are turned.

    Attributes:
        centre: (m, 3) float64 mm.
        direction: (m, 3) float64, of any length; need not be unit vectors.
        size: (m, 2) float64 mm.
    """

    centre: FloatArray
    direction: FloatArray
    size: FloatArray


class FlatGel:
    """Pixels of the undeformed gel, ready to be lit.

    Args:
        sensor: camera, window and coating; its pattern and lights do not enter.
        pixels: (n, 2) float64 px, centres of pixels of the main camera that see the contact face.
        variant: a vectorised one.
    """

    def __init__(self, sensor: Sensor, pixels: Pixels, variant: Variant) -> None:
        mi = variant.load()
        self._mi, self._count = mi, len(pixels)
        column, row = np.floor(pixels).astype(np.uint32).T
        index = mi.UInt32(row * np.uint32(sensor.camera.width) + column)
        ray, self._weight, _ = CameraRays(sensor, mi).sample(index, mi.Point2f(0.5))
        self._point = ray.o - ray.d * (ray.o.z / ray.d.z)
        self._toward = -ray.d
        plane = reflecting_plane(sensor)
        self._reflects = plane is not None
        self._index, self._face = mi.Float(sensor.window.refractive_index), mi.Float(plane or 0)
        color = {"type": "rgb", "value": list(sensor.coating.reflectance)}
        self._bsdf = mi.load_dict(coat(sensor.coating, color))

    def contributions(self, lights: LightGeometry) -> FloatArray:
        """E (m, n, 3) float64: radiance per channel and unit of power, on the camera's side of the window."""
        return np.stack(
            [self._numpy(self._lit(*self._parts(lights, i), self._unshaded(lights, i))) for i in _each(lights)]
        )

    def derivatives(self, lights: LightGeometry) -> FloatArray:
        """Derivatives of E (m, 8, n, 3) float64 by each light's centre, direction and size, in forward mode.

        A light's 8 numbers change its own contribution only, so all derivatives cost 8 pictures of each light.
        """
        return np.stack([self._derivatives(lights, i) for i in _each(lights)])

    def _derivatives(self, lights: LightGeometry, i: int) -> FloatArray:
        import drjit as dr

        found, unshaded = [], self._unshaded(lights, i)
        for part, component, sign in _NUMBERS:
            parts = self._parts(lights, i)
            for each in parts:
                dr.enable_grad(each)
                dr.set_grad(each, 0)
            seed = [0.0] * (2 if part == 2 else 3)
            seed[component] = sign
            dr.set_grad(parts[part], type(parts[part])(*seed))
            lit = self._lit(*parts, unshaded)
            found.append(self._numpy(dr.forward_to(lit)))
        return np.stack(found)

    def _parts(self, lights: LightGeometry, i: int) -> tuple[Any, Any, Any]:
        """Centre and direction of a light in the renderer's frame, and its size."""
        import drjit as dr

        mi = self._mi

        def opaque(kind: Any, values: FloatArray) -> Any:
            """Opaque numbers stay out of the compiled code: other geometry, same kernel."""
            return kind(*(dr.opaque(mi.Float, float(x)) for x in values))

        centre, direction = (opaque(mi.Vector3f, part[i] * MIRROR) for part in (lights.centre, lights.direction))
        return centre, direction, opaque(mi.Vector2f, lights.size[i])

    def _arms(self, centre: Any, direction: Any, size: Any) -> tuple[Any, Any, Any, int]:
        """Vectors from the points to the light's cells, point by point; the points; the light's normal; cells."""
        import drjit as dr

        mi = self._mi
        long = round(min(_CELLS, max(2.0, (_CELLS * float(size.x[0]) / float(size.y[0])) ** 0.5)))
        across = max(2, _CELLS // long)
        cells = long * across
        first, second, facing = _axes(mi, direction)
        lane = dr.arange(mi.UInt32, self._count * cells)
        pixel, cell = lane // cells, lane % cells
        u = (mi.Float(cell % long) + 0.5) / long - 0.5
        v = (mi.Float(cell // long) + 0.5) / across - 0.5
        source = centre + first * (u * size.x) + second * (v * size.y)
        return source - dr.gather(mi.Vector3f, self._point, pixel), pixel, facing, cells

    def _unshaded(self, lights: LightGeometry, i: int) -> Any:
        """1 where no other light's rectangle stands between a point and a cell of light i, else 0."""
        import drjit as dr

        mi = self._mi
        arm, pixel, _, _ = self._arms(*self._parts(lights, i))
        point = dr.gather(mi.Vector3f, self._point, pixel)
        free = mi.Bool(True)
        for other in _each(lights):
            if other == i:
                continue
            centre, direction, size = self._parts(lights, other)
            first, second, facing = _axes(mi, direction)
            share = dr.dot(centre - point, facing) / dr.dot(arm, facing)
            beside = point + arm * share - centre
            within = (dr.abs(dr.dot(beside, first)) < size.x / 2) & (dr.abs(dr.dot(beside, second)) < size.y / 2)
            free &= ~(within & (share > 0) & (share < 1))
        lit = dr.select(free, mi.Float(1), 0)
        dr.eval(lit)
        return lit

    def _lit(self, centre: Any, direction: Any, size: Any, unshaded: Any) -> Any:
        """Radiance (n,) as mi.Color3f under a light of power 1 and its image in the window."""
        import drjit as dr

        lit = self._scattered(centre, direction, size, lambda away: unshaded)
        if not self._reflects:
            return lit
        mi = self._mi
        flip, behind = mi.Vector3f(1, 1, -1), mi.Vector3f(0, 0, 2 * self._face)
        image = (centre * flip + behind, direction * flip, size)
        return lit + self._scattered(*image, lambda away: reflectance(dr.abs(away.z), self._index, mi))

    def _scattered(self, centre: Any, direction: Any, size: Any, share: Callable[[Any], Any]) -> Any:
        """Radiance (n,) as mi.Color3f under a rectangle of which a share arrives, by the directions to its cells."""
        import drjit as dr

        mi = self._mi
        arm, pixel, facing, cells = self._arms(centre, direction, size)
        square = dr.squared_norm(arm)
        away = arm / dr.sqrt(square)
        interaction = dr.zeros(mi.SurfaceInteraction3f, self._count * cells)
        interaction.wi = dr.gather(mi.Vector3f, self._toward, pixel)
        scattered = self._bsdf.eval(mi.BSDFContext(), interaction, away)
        cosine = dr.maximum(-dr.dot(away, facing), 0) * share(away)
        each = scattered * (cosine / (square * (dr.pi * cells)))
        return mi.Color3f(*(dr.block_sum(each[k], cells) * self._weight for k in range(3)))

    def _numpy(self, color: Any) -> FloatArray:
        return np.stack([np.array(color[k], dtype=np.float64) for k in range(3)], axis=1)


def _each(lights: LightGeometry) -> range:
    return range(len(lights.centre))


def _axes(mi: Any, direction: Any) -> tuple[Any, Any, Any]:
    """Unit vectors along a light's first and second size and of its normal, as `synth.render.lights.light_axes`."""
    import drjit as dr

    facing = dr.normalize(direction)
    first = dr.cross(mi.Vector3f(0, 0, 1), facing)
    level = dr.norm(first)
    first = dr.select(level > 1e-6, first / dr.maximum(level, 1e-6), mi.Vector3f(1, 0, 0))
    return first, dr.cross(facing, first), facing
