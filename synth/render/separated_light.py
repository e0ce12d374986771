r"""Light of a matt gel, each part sampled at its own rate: an alternative to path tracing, for vectorised variants.

A Lambertian surface's radiance is its albedo ρ times its irradiance E over π, and

.. math::  E = \sum_l (E_l - B_l) + E_{bounced} + E_{returned} .

- ρ is looked up, and the direct light E_l of light l is computed in closed form (`synth.render.polygon_light`), at
  every sample of every pixel: neither has any noise but the pixel filter's.
- B_l, what of it the gel or another light blocks, is sampled: one shadow ray for each light and sample. It is a
  control variate: nothing blocked, no noise, and the expectation is path tracing's.
- From faces of which all pilot rays reached a light, and from their neighbours, no shadow ray is traced to it. Pilots
  to a light that gives next to nothing there count as having reached it.
- E_bounced, light that the gel reflects onto itself, does not depend on the view. It is sampled at points of the gel's
  faces and projected (L²) onto functions that are linear on each face, or constant where few of the face's pilots saw
  gel: such faces get little, and its mean is less noisy than its slope. Where no pilot at all saw gel there is none.
  In a round gel, all of which sees itself, it is smooth and is fitted (`synth.render.face_points`).
- The lights l include their mirror images behind the window (`synth.render.lights`), which have no closed form.
- E_returned, light that the gel sends to the window and gets back, is smooth. It is n · V with the normal n, and V is
  fitted to sampled paths as polynomials of the place on the pad.

What remains of systematic error: shadows that all pilot rays of a neighbourhood missed, and how bounced light departs
from linear within one triangle; docs/reports/light.md measures both. Random numbers are the sampler's, sums are of
fixed order: the same seed gives the same bits.
"""

from functools import reduce
from operator import or_
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray
from synth.errors import InputError
from synth.render.face_points import FacePoints, across_cavity, count_per_face, projected
from synth.render.gel_hits import GelHits
from synth.render.gel_mesh import GelMesh
from synth.render.lights import image_lights, reaches, reflectance, reflecting_plane
from synth.render.polygon_light import PolygonLight, SampledLight
from synth.render.variant import Variant
from synth.scene import Coating, Render, Sensor

_PILOTS = 2**14
"""Rays to each light, and to the gel, from a gel of few faces; 16 from each face where there are many."""
_MANY = 0.25
"""Share of a face's pilots that must see gel for its bounced light to be linear and not constant."""
_DEGREE = 4
"""Degree of the polynomials for light that comes back from the window, which is smooth after so long a path."""
_RETURNED = 2**17
"""Paths by the window, to which they are fitted; more where there are many faces."""
_CLEARANCE_MM = 1e-3
"""Height above the gel's highest point at which rays end that look for gel alone: far more than rounding."""
_NEGLIGIBLE = 1e-4
"""Share of all light on a point up to which a light's shadows are not sampled."""
_SHIFT = (0.7548776662466927, 0.5698402909980532)
"""Shift of shadow rays from one light to the next: R2 sequence (Roberts 2018), on a torus to keep the strata."""


def is_separated(render: Render, coating: Coating, variant: Variant) -> bool:
    """Whether light is separated or path traced: decided here alone. Scalar variants path-trace.

    InputError where separated light is asked for, and the coating shines.
    """
    if render.light != "separated":
        return False
    if not coating.is_matt:
        raise InputError(
            f'render.light = "separated" needs a matt coating (roughness = 1, metallic = 0), but this sensor\'s has '
            f"roughness = {coating.roughness:g} and metallic = {coating.metallic:g}: what shines depends on the view; "
            'set render.light to "path_traced"'
        )
    return variant.is_vectorised


class SeparatedLight:
    """Light on one renderer's gel, by the lights and the window of a sensor.

    `scene` is Mitsuba's, `gels` holds the shapes "gel" and, where the window reflects, "image"; the gel's vertices are
    read from its parameters. `max_depth` is the longest path in surfaces and lights.
    """

    def __init__(
        self, sensor: Sensor, scene: Any, gels: dict[str, Any], parameters: Any, max_depth: int, is_mono: bool, mi: Any
    ) -> None:
        import drjit as dr

        self._mi, self._dr, self._scene, self._parameters = mi, dr, scene, parameters
        self._gel, self._has_image = GelHits(gels, mi), "image" in gels
        self._reflection = gels["gel"].bsdf()
        self._depth, self._channels = max_depth, 1 if is_mono else 3
        self._is_round = sensor.gel.is_round
        index = sensor.window.refractive_index
        # Used only where the window reflects.
        self._face, self._index = dr.opaque(mi.Float, reflecting_plane(sensor) or 0), dr.opaque(mi.Float, index)
        size = sensor.gel.size_mm
        own = [light for light in sensor.lights if reaches(light, size)]
        self._lights = [SampledLight(light, None, mi) if light.narrowness else PolygonLight(light, mi) for light in own]
        self._lights += [SampledLight(light, index, mi) for light in image_lights(sensor) if reaches(light, size)]
        self._half = [dr.opaque(mi.Float, side / 2) for side in size[:2]]

    def prepare(self, mesh: GelMesh, primary: int, seed: int) -> None:
        """Pilots and bounced light for the gel as it lies now in the scene, for all cameras.

        `primary` are the samples that a camera takes of it in all; the seed is non-negative, below 2^32.
        """
        mi = self._mi
        triangles = mesh.faces().reshape(-1, 3)
        self._corners = [mi.UInt32(column) for column in np.ascontiguousarray(triangles.T)]
        met = self._pilots(seed)
        touched: BoolArray = np.zeros((len(mesh.surface.material), len(self._lights)), dtype=bool)
        for corner in triangles.T:
            np.logical_or.at(touched, corner, met[:, :-1] > 0)
        near: BoolArray = np.any(touched[triangles], axis=1)
        self._shaded = [mi.Bool(np.ascontiguousarray(near[:, number])) for number in range(len(self._lights))]
        self._bounced = self._gather(triangles, met[:, -1], primary, seed) if self._depth > 2 else None
        self._returned = self._fit_returned(len(triangles), seed) if self._has_image and self._depth > 2 else None

    def radiance(self, ray: Any, sampler: Any, active: Any) -> tuple[list[Any], Any]:
        """Radiance (channels of mi.Float) along rays from the camera, and whether they meet the gel (mi.Bool)."""
        mi, dr = self._mi, self._dr
        hit = self._scene.ray_intersect_preliminary(ray, active=active)
        seen, _ = self._gel.kinds(hit, active)
        at = self._gel.point(ray, hit, False, seen)
        normal = dr.mulsign(mi.Vector3f(at.sh_frame.n), at.wi.z)  # the coating reflects on either side
        light = self._direct(at, normal, hit.prim_index, sampler.next_2d(), seen)
        if self._bounced is not None:
            weights = (1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
            for channel, values in enumerate(self._bounced):
                for value, weight in zip(values, weights, strict=True):
                    light[channel] += dr.gather(mi.Float, value, hit.prim_index, seen) * weight
        if self._returned is not None:
            terms = self._terms(at.p, normal)
            for channel, values in enumerate(self._returned):
                light[channel] += dr.maximum(sum(a * b for a, b in zip(values, terms, strict=True)), 0)
        albedo = self._albedo(at, seen)
        return [dr.select(seen, a * e / dr.pi, 0) for a, e in zip(albedo, light, strict=True)], seen

    def _direct(self, at: Any, normal: Any, face: Any, offset: Any, active: Any) -> list[Any]:
        """Irradiance (channels) of points on faces, by all lights, less what is blocked."""
        mi, dr = self._mi, self._dr
        total = [mi.Float(0) for _ in range(self._channels)]
        for number, (light, shaded) in enumerate(zip(self._lights, self._shaded, strict=True)):
            asked = active & dr.gather(mi.Bool, shaded, face, active)
            value = light.whole(at.p, normal, offset) - self._blocked(light, number, at, normal, offset, asked)
            total = [dr.fma(value, color, sum_) for color, sum_ in zip(light.radiance, total, strict=False)]
        return total

    def _blocked(self, light: PolygonLight, number: int, at: Any, normal: Any, offset: Any, asked: Any) -> Any:
        """What of `_sampled` is blocked (mi.Float): computed only where it is `asked`, 0 elsewhere."""
        dr = self._dr

        def sample(at: Any, normal: Any, offset: Any) -> Any:
            value, blocked = self._sampled(light, number, at, normal, offset)
            return dr.select(blocked, value, 0)

        return dr.if_stmt((at, normal, offset), asked, sample, lambda *_: self._mi.Float(0))

    def _sampled(self, light: PolygonLight, number: int, at: Any, normal: Any, offset: Any) -> Any:
        """Irradiance per radiance that a point of the light gives unless its ray is blocked, and whether it is."""
        dr = self._dr
        moved = [offset.x + number * _SHIFT[0] % 1, offset.y + number * _SHIFT[1] % 1]
        place, value = light.sample(at.p, normal, self._mi.Point2f(*(x - dr.floor(x) for x in moved)))
        return value, self._scene.ray_test(at.spawn_ray_to(place), value > 0)

    def _albedo(self, at: Any, active: Any) -> list[Any]:
        color = self._reflection.eval_diffuse_reflectance(at, active)
        return [color[channel] for channel in range(self._channels)]

    def _pilots(self, seed: int) -> FloatArray:
        """(faces, lights + 1) shares of a face's pilots that were blocked before a light, or met the gel."""
        dr = self._dr
        count = count_per_face(_PILOTS, dr.width(self._corners[0]))
        points = self._points(count, 2, seed)
        shared = points.at, points.normal, next(points.numbers)
        sampled = [self._sampled(light, number, *shared) for number, light in enumerate(self._lights)]
        given = [[value * c for c in light.radiance] for light, (value, _) in zip(self._lights, sampled, strict=True)]
        least = [_NEGLIGIBLE * sum(channel) for channel in zip(*given, strict=True)]
        counted = [reduce(or_, (c > limit for c, limit in zip(one, least, strict=True))) for one in given]
        met = [blocked & counts for (_, blocked), counts in zip(sampled, counted, strict=True)]
        met.append(self._onward(points.at, points.normal, next(points.numbers))[2])  # the image is no bounce
        counts = [dr.select(one, self._mi.UInt32(1), 0) for one in met]
        dr.eval(counts)
        return np.stack([np.array(dr.block_sum(one, count)) for one in counts], axis=-1) / count

    def _gather(self, triangles: NDArray[np.uint32], met: FloatArray, rays: int, seed: int) -> list[list[Any]]:
        """Bounced light (channels of 3 corners of mi.Float) on all faces from about `rays` rays.

        `met` are the shares (faces,) of pilots that met the gel.
        """
        mi, dr, count = self._mi, self._dr, count_per_face(rays, len(met))
        values = np.zeros((len(met), self._channels, 3), dtype=np.float32)
        if met.any():
            points = self._points(count, 2 * (self._depth - 2), seed + 1)
            top = np.array(self._parameters["gel.vertex_positions"])[2::3].max() + _CLEARANCE_MM
            parts = self._bounces(points, dr.opaque(mi.Float, float(top)))
            values = projected(parts, points.weights, count, met >= _MANY)
        if met.any() and self._is_round:
            positions, normals = (
                np.array(self._parameters[f"gel.vertex_{name}"], dtype=np.float64).reshape(-1, 3)
                for name in ("positions", "normals")
            )
            values = across_cavity(values.mean(axis=2), positions, normals, triangles)
        return [[mi.Float(np.ascontiguousarray(one)) for one in rows.T] for rows in values.swapaxes(0, 1)]

    def _fit_returned(self, faces: int, seed: int) -> list[Any]:
        """Coefficients (channels of mi.Float) of what the gel sends to the window and gets back, in `_terms`."""
        dr = self._dr
        points = self._points(count_per_face(_RETURNED, faces), 2 * (self._depth - 2), seed + 2)
        values = self._bounces(points)
        terms = self._terms(points.at.p, points.normal)
        dr.eval(values, terms)
        design, right = (np.array([np.array(one) for one in part], dtype=np.float64) for part in (terms, values))
        found = np.linalg.lstsq(design @ design.T, design @ right.T, rcond=None)[0]
        # Each a variable of its own: gathering them would take longer.
        return [[dr.opaque(self._mi.Float, float(value)) for value in column] for column in found.T]

    def _terms(self, point: Any, normal: Any) -> list[Any]:
        """Monomials of the place on the pad up to a degree, times each component of the normal."""
        x, y = (coordinate / half for coordinate, half in zip((point.x, point.y), self._half, strict=True))
        powers = [x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
        return [power * component for power in powers for component in (normal.x, normal.y, normal.z)]

    def _bounces(self, points: FacePoints, top: Any | None = None) -> list[Any]:
        """Irradiance (channels) from the gel itself, one path from each point.

        Its first step goes by the window, or straight: then `top` is a height that the gel does not reach.
        """
        mi, dr = self._mi, self._dr
        at, normal, count = points.at, points.normal, dr.width(points.at.p)
        total = [dr.zeros(mi.Float, count) for _ in range(self._channels)]
        share = [dr.full(mi.Float, 1, count) for _ in range(self._channels)]
        start = dr.arange(mi.UInt32, count)
        for step in range(self._depth - 2):
            offset = dr.gather(mi.Point2f, next(points.numbers), start)
            ray, hit, straight, mirrored = self._onward(at, normal, offset, None if step else top)
            active = straight | mirrored if step else mirrored if top is None else straight
            offset = dr.gather(mi.Point2f, next(points.numbers), start)
            dr.eval(ray, hit, active, mirrored, offset)  # each gather alone would trace everything anew
            onward = dr.compress(active)  # few paths meet the gel: only these go on
            if dr.width(onward) == 0:
                break
            ray, hit, mirrored, offset, start = (
                dr.gather(type(x), x, onward) for x in (ray, hit, mirrored, offset, start)
            )
            at = self._gel.point(ray, hit, mirrored, mi.Bool(True))
            normal = -mi.Vector3f(at.sh_frame.n)
            kept = dr.select(mirrored, reflectance(dr.abs(ray.d.z), self._index, mi), 1)
            albedo = self._albedo(at, mi.Bool(True))
            share = [dr.gather(mi.Float, s, onward) * a * kept for s, a in zip(share, albedo, strict=True)]
            light = self._direct(at, normal, hit.prim_index, offset, mi.Bool(True))
            for sum_, s, e in zip(total, share, light, strict=True):
                dr.scatter_add(sum_, s * e, start, mode=dr.ReduceMode.NoConflicts)
        return total

    def _onward(self, at: Any, normal: Any, offset: Any, top: Any | None = None) -> tuple[Any, Any, Any, Any]:
        """Rays in the cosine's distribution, up to `top`; their next hits; whether on the lit side of gel, or image."""
        mi, dr = self._mi, self._dr
        ray = at.spawn_ray(mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(offset)))
        if top is not None:
            ray.maxt = dr.select(ray.d.z > 0, (top - at.p.z) / ray.d.z, dr.inf)
        hit = self._scene.ray_intersect_preliminary(ray)
        straight, mirrored = self._gel.kinds(hit, mi.Bool(True))
        lit = self._gel.point(ray, hit, mirrored, straight | mirrored).wi.z < 0
        return ray, hit, lit & straight, lit & mirrored

    def _points(self, count: int, draws: int, seed: int) -> FacePoints:
        return FacePoints.on(self._corners, self._parameters, count, draws, seed, self._mi)
