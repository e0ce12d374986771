r"""What each light alone contributes to the picture of the undeformed gel, differentiable in the lights' geometry.

The undeformed contact face is a plane that cannot light itself, so its radiance toward the camera is an integral over
each light's rectangle and nothing else. For a light of power 1 and colour white, with area A, at a point x of the face:

.. math::  E_i(x) = \frac{1 - F}{n^2} \int_A f(\omega_o, \omega) \cos\theta \, \max(\cos\theta', 0)^{k + 1} \,
                    \frac{k + 2}{2 \pi A} \frac{dA'}{|x' - x|^2}

with the coating's BSDF f (Mitsuba's), θ at the face and θ' at the light, which is Lambertian for k = 0. The midpoint
rule on a grid over the rectangle evaluates it: no noise, and the same radiometry as the renderer's, with the shade that
one light throws on another. The light's mirror image behind the window adds its own integral
(`synth.render.lights`), in the shade of lights and images. A matt gel lights itself once by way of the window,
as if by its mirror image: with the radiance L of patches of area A, their reflectance ρ, and the image at the height
2 Z,

.. math::  L_{returned}(x) = \frac{ρ}{\pi} \sum_{y} A L(y) R(\theta) \frac{(2 Z)^2}{|x - y'|^4} .

Dr.Jit differentiates all of it with respect to the lights' centres, directions, sizes and viewing angles, the shade
held. Mitsuba's path integrators would as well, with noise in every step and for paths that an undeformed face has not.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Pixels, Points
from synth.render.camera_rays import CameraRays
from synth.render.chart import FlatChart
from synth.render.coating import coat
from synth.render.gel_mesh import MIRROR, GelMesh
from synth.render.lights import reflectance, reflecting_plane
from synth.render.variant import Variant
from synth.scene import Light, Sensor
from synth.surface import GelSurface

_CELLS = 24
"""Midpoints on each light; its longer side gets more of them."""
_ALONG = np.array([2, 3, 4, 6, 8, 12, 24], dtype=np.uint32)
"""Numbers of midpoints that may lie along a light's first side: divisors of `_CELLS`."""
_PATCHES = 16
"""Patches along each side of the pad that send light back by way of the window; it is smooth, so few will do."""

_ABOVE_MM = 1e-3
"""How far above a pressed face rays to the lights start, so that it does not shade itself by rounding."""

_NUMBERS = (*((part, axis) for part in (0, 1) for axis in range(3)), (2, 0), (2, 1), (3, 0))
"""Part and component of each of a light's 9 numbers; parts: centre (0), direction (1), size (2), viewing angle (3)."""


@dataclass(frozen=True, eq=False)
class LightGeometry:
    """Where m lights are, how they are turned and how widely they shine, float64.

    Centres (m, 3) and sizes (m, 2) are in mm, directions (m, 3) of any length, viewing angles (m, 1).
    """

    centre: FloatArray
    direction: FloatArray
    size: FloatArray
    viewing_angle_deg: FloatArray

    @staticmethod
    def of(lights: Sequence[Light]) -> "LightGeometry":
        numbers = [(*each.position_mm, *each.aim_mm, *each.size_mm, each.viewing_angle_deg) for each in lights]
        centre, aim, size, angle = np.split(np.array(numbers), [3, 6, 8], axis=1)
        return LightGeometry(centre, aim - centre, size, angle)


class LitGel:
    """Pixels of the gel, ready to be lit: their centres (n, 2) float64 px see its undeformed or its pressed face.

    Of the sensor camera, window and coating count, not its pattern and lights; the variant is a vectorised one. A
    pressed face, as a surface and its vertices' positions (v, 3) mm, throws shadows on itself. `points` and `normals`
    (n, 3) are what the pixels see, mm, in the scene's frame.
    """

    def __init__(
        self, sensor: Sensor, pixels: Pixels, variant: Variant, pressed: tuple[GelSurface, Points] | None = None
    ) -> None:
        mi = variant.load()
        import drjit as dr

        self._mi, self._dr, self._pixels = mi, dr, len(pixels)
        column, row = np.floor(pixels).astype(np.uint32).T
        index = mi.UInt32(row * np.uint32(sensor.camera.width) + column)
        ray, weight, _ = CameraRays(sensor, mi).sample(index, mi.Point2f(0.5))
        point, toward = np.array(ray.o - ray.d * (ray.o.z / ray.d.z)), np.array(-ray.d)
        normal = np.tile([[0.0], [0], [1]], self._pixels)
        self._relief = None
        if pressed is not None:
            self._relief = _relief(*pressed, mi)
            met = self._relief.ray_intersect(mi.Ray3f(ray))
            hit = np.array(met.is_valid())
            point, normal = np.where(hit, np.array(met.p), point), np.where(hit, -np.array(met.sh_frame.n), normal)
        self.points, self.normals = (point * MIRROR[:, None]).T, (normal * MIRROR[:, None]).T
        weight = np.broadcast_to(np.array(weight), self._pixels)
        plane = reflecting_plane(sensor)
        self._reflects = plane is not None
        self._index, self._face = mi.Float(sensor.window.refractive_index), mi.Float(plane or 0)
        color = {"type": "rgb", "value": list(sensor.coating.reflectance)}
        self._bsdf = None if sensor.coating.is_matt else mi.load_dict(coat(sensor.coating, color))
        self._albedo = np.array(sensor.coating.reflectance)
        self._returned = None
        if plane is not None and sensor.coating.is_matt:
            width, height = np.array(sensor.gel.size_mm[:2]) / _PATCHES
            middle = np.arange(_PATCHES) + 0.5 - _PATCHES / 2
            patches = np.stack([*np.meshgrid(width * middle, height * middle), np.zeros((_PATCHES, _PATCHES))])
            patches = patches.reshape(3, -1)
            square = ((point[:2, :, None] - patches[:2, None]) ** 2).sum(axis=0) + 4 * plane**2
            back = np.array(reflectance(mi.Float((2 * plane / np.sqrt(square)).ravel()), self._index, mi))
            form = back.reshape(square.shape) * 4 * plane**2 / square**2 * (width * height / np.pi)
            self._returned = (weight[:, None] * form)[..., None] * np.array(sensor.coating.reflectance)
            upward = np.tile([[0.0], [0], [1]], patches.shape[1])
            point, toward, normal = np.c_[point, patches], np.c_[toward, upward], np.c_[normal, upward]
            weight = np.r_[weight, np.ones(patches.shape[1])]
        self._count, self._weight = len(weight), weight
        self._point, self._toward, self._normal = mi.Vector3f(point), mi.Vector3f(toward), mi.Vector3f(normal)

    def contributions(self, lights: LightGeometry, alone: bool = False) -> FloatArray:
        """E (m, n, 3) float64: radiance per channel and unit of power, on the camera's side of the window.

        `alone`: as if each light were the only one, and none threw shade on another's.
        """
        parts = self._parts(lights)
        return self._numpy(self._lit(parts, self._all_unshaded(parts, alone)))

    def visible(self, lights: LightGeometry) -> FloatArray:
        """(m, n): share of each light that the pressed face lets through; 1 where the face is turned away from it."""
        parts, dr = self._parts(lights), self._dr
        arm, pixel, _, _ = self._arms(parts)
        away = dr.dot(dr.gather(self._mi.Vector3f, self._normal, pixel), arm) <= 0
        free = dr.select(away, 1, self._unshaded(parts, ()))
        share = np.array(dr.block_sum(free, _CELLS), dtype=np.float64) / _CELLS
        return share.reshape(-1, self._count)[:, : self._pixels]

    def derivatives(self, lights: LightGeometry) -> FloatArray:
        """Derivatives of E (m, 9, n, 3) float64 by each light's centre, direction, size and angle, in forward mode.

        A light's 9 numbers change its own contribution only, so all derivatives cost 9 pictures of each light.
        """
        dr, parts = self._dr, self._parts(lights)
        unshaded = self._all_unshaded(parts)
        dr.enable_grad(parts[:-1])
        lit, found = self._lit(parts, unshaded), []
        for part, component in _NUMBERS:
            dr.set_grad(parts[part][component], MIRROR[component] if part < 2 else 1)
            found.append(dr.forward_to(lit, flags=dr.ADFlag.ClearVertices))
            dr.clear_grad(lit)
        dr.eval(found)  # one kernel, which computes what they share once
        return np.stack([self._numpy(each) for each in found], axis=1)

    def _parts(self, lights: LightGeometry) -> tuple[Any, ...]:
        """Centres and directions in the renderer's frame, sizes, viewing angles, midpoints along the first size."""
        mi = self._mi
        angle = (mi.Float(lights.viewing_angle_deg[:, 0]),)
        turned = (mi.Vector3f((part * MIRROR).T) for part in (lights.centre, lights.direction))
        nearest = np.abs(np.log(_ALONG**2 / _CELLS * (lights.size[:, 1:] / lights.size[:, :1]))).argmin(axis=1)
        return *turned, mi.Vector2f(lights.size.T), angle, mi.UInt32(_ALONG[nearest])

    def _arms(self, parts: tuple[Any, ...]) -> tuple[Any, Any, Any, Any]:
        """For each light, point and cell: vector from point to cell, numbers of point and light, the light's normal."""
        mi, dr = self._mi, self._dr
        centre, direction, size, _, along = parts
        lane = dr.arange(mi.UInt32, dr.width(centre) * self._count * _CELLS)
        cell, pixel, light = lane % _CELLS, lane // _CELLS % self._count, lane // (_CELLS * self._count)
        long = dr.maximum(dr.gather(mi.UInt32, along, light), 1)  # lanes that fill up a vector gather 0, and divide too
        first, second, facing = (dr.gather(mi.Vector3f, axis, light) for axis in self._axes(direction))
        width, height = dr.gather(mi.Float, size.x, light), dr.gather(mi.Float, size.y, light)
        u = (mi.Float(cell % long) + 0.5) / mi.Float(long) - 0.5
        v = (mi.Float(cell // long) + 0.5) * mi.Float(long) / _CELLS - 0.5
        source = dr.gather(mi.Vector3f, centre, light) + first * (u * width) + second * (v * height)
        return source - dr.gather(mi.Vector3f, self._point, pixel), pixel, light, facing

    def _axes(self, direction: Any) -> tuple[Any, Any, Any]:
        """Unit vectors along a light's first and second size and of its normal, as `synth.render.lights.light_axes`."""
        mi, dr = self._mi, self._dr
        facing = dr.normalize(direction)
        first = dr.cross(mi.Vector3f(0, 0, 1), facing)
        level = dr.norm(first)
        first = dr.select(level > 1e-6, first / dr.maximum(level, 1e-6), mi.Vector3f(1, 0, 0))
        return first, dr.cross(facing, first), facing

    def _image(self, parts: tuple[Any, ...]) -> tuple[Any, ...]:
        """The lights' mirror images behind the window."""
        flip, behind = self._mi.Vector3f(1, 1, -1), self._mi.Vector3f(0, 0, 2 * self._face)
        return parts[0] * flip + behind, parts[1] * flip, *parts[2:]

    def _all_unshaded(self, parts: tuple[Any, ...], alone: bool = False) -> tuple[Any, ...]:
        """`_unshaded` of the lights and, where the window reflects, of their images."""
        if not self._reflects:
            return (self._unshaded(parts, () if alone else (parts,)),)
        image = self._image(parts)
        obstacles = ((), ()) if alone else ((parts,), (image, parts))
        return self._unshaded(parts, obstacles[0]), self._unshaded(image, obstacles[1])

    def _unshaded(self, parts: tuple[Any, ...], obstacles: tuple[tuple[Any, ...], ...]) -> Any:
        """1 where no rectangle but its own stands between a point and a light's cell, else 0.

        The obstacles are `parts` themselves first, then others.
        """
        mi, dr = self._mi, self._dr
        arm, pixel, light, _ = self._arms(parts)
        point = dr.gather(mi.Vector3f, self._point, pixel)
        free = dr.full(mi.Bool, True, dr.width(arm))
        for centres, directions, sizes, *_ in obstacles:
            for other in range(dr.width(centres)):
                number = dr.opaque(mi.UInt32, other)
                centre, direction = (dr.gather(mi.Vector3f, part, number) for part in (centres, directions))
                size = dr.gather(mi.Vector2f, sizes, number)
                first, second, facing = self._axes(direction)
                share = dr.dot(centre - point, facing) / dr.dot(arm, facing)
                beside = point + arm * share - centre
                within = (dr.abs(dr.dot(beside, first)) < size.x / 2) & (dr.abs(dr.dot(beside, second)) < size.y / 2)
                itself = (light == number) & (centres is parts[0])
                free &= ~(within & (share > 0) & (share < 1) & ~itself)
        if self._relief is not None:
            start = mi.Point3f(point + dr.gather(mi.Vector3f, self._normal, pixel) * _ABOVE_MM)
            free &= ~self._relief.ray_test(mi.Ray3f(start, dr.normalize(arm), dr.norm(arm), 0, []))
        lit = dr.select(free, mi.Float(1), 0)
        dr.eval(lit)
        return lit

    def _lit(self, parts: tuple[Any, ...], unshaded: tuple[Any, ...]) -> Any:
        """Radiance by each cell of each light of power 1 and its image in the window, as `_scattered`."""
        lit = self._scattered(parts, unshaded[0], is_image=False)
        return lit + self._scattered(self._image(parts), unshaded[1], is_image=True) if self._reflects else lit

    def _scattered(self, parts: tuple[Any, ...], unshaded: Any, is_image: bool) -> Any:
        """Radiance by cells of rectangles, or of images of them that the window weakens.

        A matt coating's is mi.Float, for a white one; others' is mi.Color3f.
        """
        mi, dr = self._mi, self._dr
        arm, pixel, light, facing = self._arms(parts)
        square = dr.squared_norm(arm)
        away = arm / dr.sqrt(square)
        normal = dr.gather(mi.Vector3f, self._normal, pixel)
        if self._bsdf is None:
            scattered = dr.maximum(dr.dot(normal, away), 0) / dr.pi
        else:
            interaction, frame = dr.zeros(mi.SurfaceInteraction3f, dr.width(arm)), mi.Frame3f(normal)
            interaction.wi = frame.to_local(dr.gather(mi.Vector3f, self._toward, pixel))
            scattered = self._bsdf.eval(mi.BSDFContext(), interaction, frame.to_local(away))
        power = -dr.log(2) / dr.log(dr.cos(dr.deg2rad(parts[3][0] / 2)))  # of the intensity: Light.narrowness + 1
        share = unshaded * reflectance(dr.abs(away.z), self._index, mi) if is_image else unshaded
        cosine = dr.power(dr.maximum(-dr.dot(away, facing), 1e-6), dr.gather(mi.Float, power, light)) * share
        return scattered * (cosine * dr.gather(mi.Float, power + 1, light) / (square * (2 * dr.pi * _CELLS)))

    def _numpy(self, cells: Any) -> FloatArray:
        """(m, n, 3): radiance on the camera's side of the window, of `_lit`."""
        dr = self._dr
        sums = [dr.block_sum(each, _CELLS) for each in ((cells,) if self._bsdf is None else cells)]
        dr.eval(sums)
        whole = np.stack([np.array(each, dtype=np.float64).reshape(-1, self._count) for each in sums], axis=-1)
        whole = whole * self._weight[:, None] * (self._albedo if self._bsdf is None else 1.0)
        seen, patches = whole[:, : self._pixels], whole[:, self._pixels :]
        return (
            seen if self._returned is None else seen + np.einsum("npc,mpc->mnc", self._returned, patches, optimize=True)
        )


@dataclass(frozen=True, eq=False)
class PressChange:
    """What a press changes at pixels: the light of the pressed face less that of the face at rest, as of a `LitGel`."""

    pressed: LitGel
    rest: LitGel

    def contributions(self, lights: LightGeometry, alone: bool = False) -> FloatArray:
        return self.pressed.contributions(lights, alone) - self.rest.contributions(lights, alone)

    def derivatives(self, lights: LightGeometry) -> FloatArray:
        return self.pressed.derivatives(lights) - self.rest.derivatives(lights)


def _relief(surface: GelSurface, positions: Points, mi: Any) -> Any:
    """Mitsuba's scene of a pressed face alone."""
    mesh = GelMesh(surface, FlatChart((1.0, 1.0)))
    shape = mi.Mesh("gel", len(positions), len(surface.triangles), has_vertex_normals=True)
    parameters = mi.traverse(shape)
    parameters["faces"], parameters["vertex_positions"] = mesh.faces(), mesh.positions(positions)
    parameters["vertex_normals"] = mesh.normals(positions)
    parameters.update()
    return mi.load_dict({"type": "scene", "gel": shape})
