r"""Light of a matt gel, each part sampled at its own rate: an alternative to path tracing, for vectorised variants.

A Lambertian surface's radiance is its albedo ρ times its irradiance E over π, and

.. math::  E = \sum_l (E_l - B_l) + E_{bounced} + E_{returned} .

- ρ is looked up at every sample of every pixel. The direct light E_l = n · V_l of light l is computed without noise
  (`synth.render.polygon_light`): the vector V_l once a pixel, where its samples meet the gel in the mean, the product
  with the normal n at every sample.
- B_l, what of it the gel or another light blocks, is sampled: one shadow ray for each light and sample. It is a
  control variate: nothing blocked, no noise, and the expectation is path tracing's.
- From faces of which all pilot rays reached a light, and from their neighbours, no shadow ray is traced to it. Pilots
  to a light that gives next to nothing there count as having reached it.
- E_bounced, light that the gel reflects onto itself, does not depend on the view. It is sampled at points of the gel's
  faces and projected (L²) onto functions that are linear on each face, or constant where few of the face's pilots saw
  gel: such faces get little, and its mean is less noisy than its slope. A plane has none. It begins as the mean light
  of a face's pilots.
  In a round gel, all of which sees itself, it is smooth and is fitted (`synth.render.smooth_light`).
- The lights l include their mirror images behind the window (`synth.render.lights`).
- E_returned, light that the gel sends to the window and gets back, is smooth and fitted as well.

Measured light (`synth.render.measured_light`) replaces E_l where the sampled point of light l is not blocked. It was
measured with what is bounced and returned at rest, so that neither is added.

What remains of systematic error: shadows that all pilot rays of a neighbourhood missed, and how bounced light departs
from linear within one triangle; docs/reports/light.md measures both. Random numbers are the sampler's, sums are of
fixed order: the same seed gives the same bits.

Nothing here depends on a value that is read back, so that a frame is recorded once and replayed (`drjit.freeze`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import Any

from synth.render.albedo_map import AlbedoMap
from synth.render.face_points import FacePoints, count_per_face, projected
from synth.render.gel_hits import GelHits
from synth.render.light_words import BITS, bits
from synth.render.lights import image_lights, reaches, reflectance
from synth.render.measured_light import LightModel, MeasuredLight
from synth.render.polygon_light import LightTable, PolygonLight
from synth.render.smooth_light import fitted
from synth.scene import Light, Sensor

_PILOTS = 2**14
"""Rays to each light, and to the gel, from a gel of few faces; 16 from each face where there are many."""
_MANY = 0.25
"""Share of a face's pilots that must see gel for its bounced light to be linear and not constant."""
_RETURNING_PATHS = 144
"""Paths from each point at which light that comes back from the window is sampled."""
_NEGLIGIBLE = 3e-3
"""Share of all light on a point up to which a light's shadows are not sampled."""
_NODES, _PILOT_NODES = 14, 6
"""Points of a light without closed form for a pixel, and for a point of a face."""
_SHIFT = (0.7548776662466927, 0.5698402909980532)
"""Shift of shadow rays from one light to the next: R2 sequence (Roberts 2018), on a torus to keep the strata."""


@dataclass(init=False, eq=False)
class SeparatedLight:
    """Light on one renderer's gel, by the lights and the window of a sensor.

    `scene` is Mitsuba's, which holds the gel and, where the window reflects, its image. `max_depth` is the longest path
    in surfaces and lights.
    """

    max_depth: int
    _mi: Any
    _dr: Any
    _scene: Any
    _gel: GelHits
    _albedo: AlbedoMap
    _channels: int
    _index: Any
    _words: int
    _lights: list[LightTable]
    _measured: MeasuredLight | None

    def __init__(
        self,
        sensor: Sensor,
        scene: Any,
        gel: GelHits,
        albedo: AlbedoMap,
        measured: LightModel | None,
        depth: int,
        mi: Any,
    ) -> None:
        import drjit as dr

        self._mi, self._dr, self._scene = mi, dr, scene
        self._gel, self._albedo = gel, albedo
        self.max_depth, self._channels = depth, albedo.channels
        index = sensor.window.refractive_index
        self._index = dr.opaque(mi.Float, index)  # used only where the window reflects
        size = sensor.gel.size_mm
        self._measured = None if measured is None else MeasuredLight(measured, sensor, self._channels, mi)
        own = [light for light in sensor.lights if reaches(light, size)]
        images = [light for light in image_lights(sensor) if reaches(light, size)]
        if measured is not None:  # all that shine, in their order, for their shadows alone
            lambertian = {"viewing_angle_deg": 120.0}
            own, images = [light.model_copy(update=lambertian) for light in sensor.lights if light.power > 0], []
        kinds: list[tuple[list[Light], dict[str, Any]]] = [
            ([light for light in own if not light.narrowness], {}),
            ([light for light in own if light.narrowness], {"sampled": True}),
            (images, {"sampled": True, "index": index}),
        ]
        self._lights = [LightTable(lights, albedo.channels, mi, **kind) for lights, kind in kinds if lights]
        self._words = -(-(len(own) + len(images)) // BITS)

    @property
    def static(self) -> tuple[Any, ...]:
        """What of the light is compiled into kernels."""
        tables = tuple(table.static for table in self._lights)
        return self.max_depth, self._channels, self._words, tables, self._measured and self._measured.degree

    def prepare(
        self, frame: dict[str, Any], sizes: tuple[int, int], primary: int, bounces: bool
    ) -> tuple[list[Any], list[list[Any]]]:
        """What all cameras share of the gel as it lies now in the scene: for `radiance`.

        Args:
            frame: from `FrameGeometry.numbers`.
            sizes: numbers of vertices and faces.
            primary: paths of bounced light in all.
            bounces: whether the gel may light itself.

        Returns:
            Faces' masks of lights that something may block (mi.UInt32 for each 32 lights), and indirect irradiance at
            faces' corners (channels of 3 of mi.Float), without channels where there is none.
        """
        mi, dr, gel, faces = self._mi, self._dr, self._gel, sizes[1]
        masks, direct, seen = self._pilots(frame["seeds"][0], faces)
        shaded = [self._with_neighbours(mask, sizes[0]) for mask in masks]
        indirect: list[list[Any]] = []
        if bounces:
            count = count_per_face(primary, faces)
            points = FacePoints.on(gel, count, self.max_depth - 2, frame["seeds"][1], mi)
            values = self._bounces(points, direct, frame["top"])
            if frame["cavity"] is None:
                indirect = projected(values, points.weights, count, seen)
            else:
                indirect = self._smooth(frame["cavity"], values, count)
        if frame["returning"] is not None:
            draws, seed = self.max_depth - 2, frame["seeds"][2]
            points = FacePoints.on(gel, _RETURNING_PATHS, draws, seed, mi, frame["returning"])
            values = self._bounces(points, direct)
            returned = self._smooth(frame["window"], values, _RETURNING_PATHS)
            both = zip(indirect or returned, returned, strict=True)
            indirect = [[a + b for a, b in zip(*pair, strict=True)] for pair in both] if indirect else returned
        dr.eval(shaded, indirect)
        return shaded, indirect

    def radiance(
        self, ray: Any, sampler: Any, active: Any, prepared: tuple[list[Any], list[list[Any]]], samples: int
    ) -> tuple[list[Any], Any]:
        """Radiance (channels of mi.Float) along rays from the camera, and whether they meet the gel (mi.Bool).

        `samples` successive rays belong to one pixel.
        """
        mi, dr = self._mi, self._dr
        shaded, indirect = prepared
        hit = self._scene.ray_intersect_preliminary(ray, active=active)
        seen, _ = self._gel.kinds(hit, active)
        at = self._gel.point(ray, hit, False, seen)
        normal = dr.mulsign(mi.Vector3f(at.sh_frame.n), at.wi.z)  # the coating reflects on either side
        if self._measured is None:
            dr.eval(at.p, at.n, at.uv, normal, seen, hit.prim_index, hit.prim_uv)
            count = dr.maximum(dr.block_sum(dr.select(seen, mi.Float(1), 0), samples), 1)
            place, facing = (
                mi.Vector3f([dr.block_sum(dr.select(seen, x, 0), samples) for x in of]) for of in (at.p, normal)
            )
            vectors = self._whole(place / count, dr.normalize(facing), _NODES)
            dr.eval(vectors)
            light = [dr.dot(normal, dr.repeat(vector, samples)) for vector in vectors]
        else:
            measured = self._measured

            def give(_: PolygonLight, number: Any, *total: Any) -> list[Any]:
                given = measured.irradiance(number, at, normal, seen)
                return [a + b for a, b in zip(given, total, strict=True)]

            light = self._over_lights(give, [mi.Float(0) for _ in range(self._channels)])
        light = self._less_blocked(light, at, normal, hit.prim_index, sampler.next_2d(), shaded, seen)
        weights = (1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
        for channel, values in enumerate(indirect):
            for value, weight in zip(values, weights, strict=True):
                light[channel] += dr.gather(mi.Float, value, hit.prim_index, seen) * weight
        albedo = self._albedo.at(at.uv, seen)
        return [dr.select(seen, a * e / dr.pi, 0) for a, e in zip(albedo, light, strict=True)], seen

    def _smooth(self, fit: dict[str, Any], values: list[Any], count: int) -> list[list[Any]]:
        """Irradiance at faces' corners, fitted to `count` samples (channels of mi.Float) at each of the fit's nodes."""
        mi, dr, gel = self._mi, self._dr, self._gel
        dr.eval(values)
        means = [dr.block_sum(value, count) / count for value in values]
        dr.eval(means)
        smooth = fitted(fit, means, gel.positions, gel.normals, mi)
        dr.eval(smooth)
        return [[dr.gather(mi.Float, channel, corner) for corner in gel.corners] for channel in smooth]

    def _whole(self, point: Any, normal: Any, nodes: int) -> list[Any]:
        """Vector irradiance (channels of mi.Vector3f) of points by all lights, nothing standing between."""

        def add(light: PolygonLight, number: Any, *total: Any) -> list[Any]:
            value = light.whole(point, normal, nodes)
            return [value * color + sum_ for color, sum_ in zip(light.radiance, total, strict=True)]

        return self._over_lights(add, [self._mi.Vector3f(0) for _ in range(self._channels)])

    def _less_blocked(
        self, light: list[Any], at: Any, normal: Any, face: Any, offset: Any, shaded: list[Any], active: Any
    ) -> list[Any]:
        """Irradiance (channels) of points on faces less what is blocked of it."""
        mi, dr = self._mi, self._dr
        masks = [dr.gather(mi.UInt32, mask, face, active) for mask in shaded]

        def subtract(light: PolygonLight, number: Any, *total: Any) -> list[Any]:
            value, blocked = self._sampled(light, number, at, normal, offset)
            if self._measured is None:
                lost, given = dr.select(blocked, -value, 0), light.radiance
            else:
                lost = dr.select(blocked & (value > 0), mi.Float(-1), 0)
                given = self._measured.irradiance(number, at, normal, active)
            return [dr.fma(lost, color, sum_) for color, sum_ in zip(given, total, strict=True)]

        return self._over_marked(subtract, light, masks)

    def _over_lights(self, add: Callable[..., list[Any]], sums: list[Any]) -> list[Any]:
        """Sums after `add`, called with each light, its number (mi.UInt32) and the sums so far."""
        mi, dr = self._mi, self._dr
        before = mi.UInt32(0)
        for table in self._lights:

            def step(k: Any, *sums: Any, table: LightTable = table, before: Any = before) -> tuple[Any, ...]:
                return k + 1, *add(table.light(k), before + k, *sums)

            def goes_on(k: Any, *_: Any, table: LightTable = table) -> Any:
                return k < table.count

            _, *sums = dr.while_loop((mi.UInt32(0), *sums), goes_on, step)
            before = before + table.count
        return sums

    def _over_marked(self, add: Callable[..., list[Any]], sums: list[Any], masks: list[Any]) -> list[Any]:
        """As `_over_lights`, with those alone whose bits are set: few, so that a loop goes from one to the next."""
        mi, dr = self._mi, self._dr
        before = mi.Int32(0)
        for table in self._lights:
            after = before + mi.Int32(table.count)
            for word, mask in enumerate(masks):
                first = BITS * word

                def step(
                    left: Any, *sums: Any, table: LightTable = table, before: Any = before, first: int = first
                ) -> tuple[Any, ...]:
                    number = mi.Int32(dr.tzcnt(left)) + first
                    light = table.light(mi.UInt32(number - before))
                    return left & (left - 1), *add(light, mi.UInt32(number), *sums)

                own = mask & bits(before - first, after - first, mi)
                _, *sums = dr.while_loop((own, *sums), lambda left, *_: left != 0, step)
            before = after
        return sums

    def _sampled(self, light: PolygonLight, number: Any, at: Any, normal: Any, offset: Any) -> Any:
        """Irradiance per radiance that a point of the light gives unless its ray is blocked, and whether it is."""
        mi, dr = self._mi, self._dr
        moved = mi.Point2f(offset) + mi.Float(number) * mi.Point2f(*_SHIFT)
        place, vector = light.sample(at.p, moved - dr.floor(moved))
        value = dr.maximum(dr.dot(vector, normal), 0)
        return value, self._scene.ray_test(at.spawn_ray_to(place), value > 0)

    def _pilots(self, seed: Any, faces: int) -> tuple[list[Any], list[Any], Any]:
        """What rays from all faces find out.

        Returns:
            Of each face, masks of the lights before which one was blocked, irradiance by all lights (channels of
            mi.Float), and whether many met the gel (mi.Bool).
        """
        mi, dr = self._mi, self._dr
        count = count_per_face(_PILOTS, faces)
        points = FacePoints.on(self._gel, count, 2, seed, mi)
        at, normal, offset = points.at, points.normal, next(points.numbers)
        whole = [dr.dot(vector, normal) for vector in self._whole(at.p, normal, _PILOT_NODES)]

        def mark(light: PolygonLight, number: Any, *sums: Any) -> list[Any]:
            value, blocked = self._sampled(light, number, at, normal, offset)
            lost = [dr.select(blocked, value * color, 0) for color in light.radiance]
            counts = reduce(or_, (less > _NEGLIGIBLE * total for less, total in zip(lost, whole, strict=True)))
            bit = dr.select(counts, mi.UInt32(1) << (number % BITS), 0)
            left = [sum_ - less for sum_, less in zip(sums[self._words :], lost, strict=True)]
            masks = [m | dr.select(number // BITS == word, bit, 0) for word, m in enumerate(sums[: self._words])]
            return [*masks, *left]

        found = self._over_lights(mark, [mi.UInt32(0) for _ in range(self._words)] + whole)
        _, _, straight, _ = self._onward(at, normal, next(points.numbers))  # the image is no bounce
        met = dr.select(straight, mi.UInt32(1), 0)
        dr.eval(found, met)
        masks = [dr.block_reduce(dr.ReduceOp.Or, mask, count) for mask in found[: self._words]]
        light = [dr.maximum(dr.block_sum(each, count) / count, 0) for each in found[self._words :]]
        return masks, light, dr.block_sum(met, count) >= _MANY * count

    def _with_neighbours(self, mask: Any, vertices: int) -> Any:
        """Masks of faces (mi.UInt32), each with those of all faces that share a vertex with it."""
        mi, dr = self._mi, self._dr
        touched = dr.zeros(mi.UInt32, vertices)
        for corner in self._gel.corners:
            dr.scatter_reduce(dr.ReduceOp.Or, touched, mask, corner)
        return reduce(or_, (dr.gather(mi.UInt32, touched, corner) for corner in self._gel.corners))

    def _bounces(self, points: FacePoints, direct: list[Any], top: Any | None = None) -> list[Any]:
        """Irradiance (channels) from the gel itself, one path from each point.

        Its first step goes by the window, or straight: then `top` is a height that the gel does not reach. `direct` is
        the light of faces, from `_pilots`.
        """
        mi, dr = self._mi, self._dr
        at, normal, active = points.at, points.normal, mi.Bool(True)
        total, share = ([mi.Float(value) for _ in range(self._channels)] for value in (0, 1))
        for step in range(self.max_depth - 2):
            ray, hit, straight, mirrored = self._onward(at, normal, next(points.numbers), None if step else top)
            active &= straight | mirrored if step else mirrored if top is None else straight
            at = self._gel.point(ray, hit, mirrored, active)
            normal = -mi.Vector3f(at.sh_frame.n)
            kept = dr.select(mirrored, reflectance(dr.abs(ray.d.z), self._index, mi), 1)
            share = [s * a * kept for s, a in zip(share, self._albedo.at(at.uv, active), strict=True)]
            light = [dr.gather(mi.Float, each, hit.prim_index, active) for each in direct]
            total = [sum_ + dr.select(active, s * e, 0) for sum_, s, e in zip(total, share, light, strict=True)]
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
