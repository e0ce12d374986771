r"""Path tracing of the gel under its lights, for vectorised variants.

At every point of a path light is sampled in two ways: from one of the rectangles, chosen evenly, and from wherever the
path goes on to. Both are weighted by the power heuristic (Veach, Robust Monte Carlo Methods, 1997, § 9.2). Lights are
numbers in tables and not Mitsuba's emitters, whose virtual functions Dr.Jit would record one by one in every pass.

Paths that the window reflects go on in the space behind it (`synth.render.lights`). A path that meets the mirror
image of the gel is mirrored back onto the gel there, so that each of its rays starts in front of the window.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.render.gel_hits import GelHits
from synth.render.lights import all_lights, rectangles, reflectance, reflecting_plane
from synth.scene import Sensor


@dataclass(init=False, eq=False)
class PathTracer:
    """Light on one renderer's gel, by the lights and the window of a sensor.

    `scene` is Mitsuba's, `shapes` are those in it: "gel", "lights", and "image" where the window reflects. `max_depth`
    is the longest path in surfaces and lights.
    """

    _mi: Any
    _dr: Any
    _scene: Any
    _gel: GelHits
    _reflection: Any
    _lights: Any
    _face: Any
    _index: Any
    _depth: Any
    _count: Any
    _before: Any
    _places: list[Any]
    _areas: Any
    _radiance: Any
    _narrowness: Any

    def __init__(
        self, sensor: Sensor, scene: Any, gel: GelHits, shapes: dict[str, Any], max_depth: int, mi: Any
    ) -> None:
        import drjit as dr

        self._mi, self._dr, self._scene = mi, dr, scene
        self._reflection, self._gel = shapes["gel"].bsdf(), gel
        self._lights = mi.ShapePtr(shapes["lights"])
        dr.make_opaque(self._lights)
        self._face = dr.opaque(mi.Float, reflecting_plane(sensor) or 0)
        self._index, self._depth = dr.opaque(mi.Float, sensor.window.refractive_index), dr.opaque(mi.UInt32, max_depth)
        lights = all_lights(sensor)
        self._count = dr.opaque(mi.UInt32, len(lights))
        self._before = dr.opaque(mi.UInt32, len(lights) // (2 if "image" in shapes else 1))  # images come last
        self._places = [mi.Float(column.ravel()) for column in rectangles(lights).astype(np.float32).swapaxes(0, 1)]
        self._areas = mi.Float([light.size_mm[0] * light.size_mm[1] for light in lights])
        given = np.array([light.radiance[: len(mi.Spectrum(0))] for light in lights], dtype=np.float32)
        self._radiance = mi.Float(given.ravel())
        narrowness = [light.narrowness for light in lights]
        self._narrowness = mi.Float(narrowness) if any(narrowness) else None

    def radiance(self, ray: Any, sampler: Any, active: Any, *_: Any) -> tuple[Any, Any]:
        """Radiance (mi.Spectrum) along rays from the camera, and whether they meet the gel (mi.Bool)."""
        mi, dr = self._mi, self._dr
        share, total, depth, density = mi.Spectrum(1), mi.Spectrum(0), mi.UInt32(0), mi.Float(0)
        start = (mi.Ray3f(ray), sampler, share, total, depth, density, active, mi.Bool(False))
        _, _, _, total, _, _, _, seen = dr.while_loop(start, lambda *state: state[6], self._step)
        return total, seen

    def _step(
        self, ray: Any, sampler: Any, share: Any, total: Any, depth: Any, density: Any, active: Any, seen: Any
    ) -> tuple[Any, ...]:
        """Follow rays to what they meet, add the light there, and send them on.

        The camera gets `share` of the light that comes along a ray, whose direction was drawn with the `density` per
        solid angle.
        """
        mi, dr = self._mi, self._dr
        context = mi.BSDFContext()
        hit = self._scene.ray_intersect_preliminary(ray, active=active)
        met = active & hit.is_valid()
        shines = met & (hit.shape == self._lights)
        given, chance = self._towards(hit.prim_index // 2, ray.d, dr.square(hit.t), shines & (depth > 0))
        total = total + share * given * _weight(density, chance)
        goes = met & ~shines
        _, mirrored = self._gel.kinds(hit, goes)
        at = self._gel.point(ray, hit, mirrored, goes)
        share = share * dr.select(mirrored, reflectance(dr.abs(ray.d.z), self._index, mi), 1)
        seen = seen | (goes & (depth == 0))
        goes &= depth + 1 < self._depth

        offset = sampler.next_2d(goes)
        chosen = offset.x * mi.Float(self._count)
        number = dr.minimum(mi.UInt32(chosen), self._count - 1)
        corner, first, second = (dr.gather(mi.Vector3f, self._places[k], number, goes) for k in range(3))
        place = mi.Point3f(corner + first * (chosen - mi.Float(number)) + second * offset.y)
        arm = place - at.p
        square = dr.squared_norm(arm)
        arm *= dr.rsqrt(square)
        given, chance = self._towards(number, arm, square, goes)
        lit = goes & (chance > 0)
        reflected, density = self._reflection.eval_pdf(context, at, at.to_local(arm), lit)
        lit &= ~self._scene.ray_test(at.spawn_ray_to(place), lit)
        total = total + dr.select(lit, share * reflected * given * (_weight(chance, density) / chance), 0)

        onward, kept = self._reflection.sample(context, at, sampler.next_1d(goes), sampler.next_2d(goes), goes)
        share = share * kept
        goes &= dr.any(share != 0)
        ray = at.spawn_ray(at.to_world(onward.wo))
        return ray, sampler, share, total, depth + 1, onward.pdf, goes, seen

    def _towards(self, number: Any, direction: Any, square: Any, active: Any) -> tuple[Any, Any]:
        """Radiance of lights along unit directions to them; the density per solid angle with which these are chosen.

        `square` is the squared distance. Both are 0 for a light's back.
        """
        mi, dr = self._mi, self._dr
        front = -dr.dot(direction, dr.gather(mi.Vector3f, self._places[3], number, active))
        active = active & (front > 0)
        area = dr.gather(mi.Float, self._areas, number, active)
        given = dr.gather(mi.Spectrum, self._radiance, number, active)
        if self._narrowness is not None:
            given *= dr.power(dr.maximum(front, 0), dr.gather(mi.Float, self._narrowness, number, active))
        kept = dr.select(number < self._before, 1, reflectance(dr.abs(direction.z), self._index, mi))
        density = dr.select(active, square / (front * area * mi.Float(self._count)), 0)
        return dr.select(active, given * kept, 0), density


def _weight(own: Any, other: Any) -> Any:
    """The power heuristic's weight of what was drawn with the density `own`; 0 where both are."""
    import drjit as dr

    return dr.select(own > 0, dr.square(own) / (dr.square(own) + dr.square(other)), 0)
