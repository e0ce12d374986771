r"""Rectangular lights for vectorised variants: their irradiance in closed form, and points on them.

A Lambertian rectangle of radiance L, seen whole, lights a surface with normal n by (Lambert, Photometria, 1760)

.. math::  E = \frac{L}{2} \sum_i \theta_i \; n \cdot \frac{a_i \times a_{i+1}}{|a_i \times a_{i+1}|},

where a_i are the unit vectors to its corners, the part below the surface's horizon cut off, and θ_i the angles between
neighbours. With c = a_i · a_{i+1} = cos θ the factor θ / sin θ = (θ/2 / sin(θ/2)) / cos(θ/2) needs no arc cosine: the
first quotient is smooth in 1 - cos(θ/2) up to θ = π and is taken from a polynomial.

The rectangles are those of `synth.render.lights`, in the renderer's frame, and shine to their front only.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from numpy.polynomial.legendre import leggauss

from synth.render.aligned import aligned
from synth.render.lights import rectangles, reflectance
from synth.scene import Light

_DEGREE = 9
"""Degree of the polynomial, which errs by 2e-8, less than float32's rounding."""
_LEAST = 1e-6
"""Least cosine at a light that is raised to a power: 0 to the power 0, of a Lambertian light seen edge-on, is NaN."""
_ACROSS = 0.5 / math.sqrt(3)
"""Distance of points from a light's middle line, in its width: of Gauss and Legendre's rule with two points."""


@dataclass(eq=False)
class PolygonLight:
    """One light, all of whose numbers are Dr.Jit's; its radiance has a list of channels."""

    mi: Any
    corner: Any
    sides: tuple[Any, Any]
    front: Any
    area: Any
    radiance: list[Any]

    def whole(self, point: Any, normal: Any, nodes: int) -> Any:
        """Vector irradiance per radiance (mi.Vector3f) of surface points with unit normals, nothing standing between.

        A light without a closed form is integrated by Gauss and Legendre's rule with that many nodes along its first
        side, on either side of its middle in turn. The vector's product with the normal is the irradiance; with others,
        too, as long as they see as much of the light.
        """
        import drjit as dr

        (first, second), corner = self.sides, self.corner
        corners = [corner, corner + first, corner + first + second, corner + second]
        rays = [dr.normalize(self.mi.Vector3f(corner - point)) for corner in corners]
        heights = [dr.dot(ray, normal) for ray in rays]
        lowest = dr.minimum(dr.minimum(heights[0], heights[1]), dr.minimum(heights[2], heights[3]))
        value = dr.if_stmt((rays, heights), lowest >= 0, self._risen, self._cut)
        value = 0.5 * dr.mulsign(value, dr.dot(value, normal))  # whichever way round the corners are seen
        return dr.select(dr.dot(point - self.corner, self.front) > 0, value, 0)

    def sample(self, point: Any, offset: Any) -> tuple[Any, Any]:
        """A point of the light, and the vector irradiance per radiance as if all of it stood there.

        `whole` is its mean over points that the surface sees. The surface's point is a mi.Point3f; `offset` is a
        mi.Point2f in [0, 1)².
        """
        import drjit as dr

        place = self.corner + self.sides[0] * offset.x + self.sides[1] * offset.y
        arm = self.mi.Vector3f(place - point)
        square = dr.squared_norm(arm)
        return self.mi.Point3f(place), arm * (dr.maximum(-dr.dot(arm, self.front), 0) * self.area / dr.square(square))

    def _risen(self, rays: list[Any], heights: list[Any]) -> Any:
        return sum((_edge(rays[i], rays[(i + 1) % 4]) for i in range(4)), self.mi.Vector3f(0))

    def _cut(self, rays: list[Any], heights: list[Any]) -> Any:
        """As `_risen`, cut at the horizon: one edge more, from where the outline sets to where it rises."""
        import drjit as dr

        mi = self.mi
        total, setting, rising = mi.Vector3f(0), mi.Vector3f(0), mi.Vector3f(0)
        for i in range(4):
            (a, b), (high, low) = ((values[i], values[(i + 1) % 4]) for values in (rays, heights))
            sets, rises = (high > 0) & (low <= 0), (high <= 0) & (low > 0)
            at = dr.normalize(a + (b - a) * (high / (high - low)))
            part = _edge(dr.select(rises, at, a), dr.select(sets, at, b))
            total += dr.select((high > 0) | (low > 0), part, 0)
            setting, rising = dr.select(sets, at, setting), dr.select(rises, at, rising)
        total += dr.select(dr.squared_norm(setting) > 0, _edge(setting, rising), 0)
        return total


@dataclass(eq=False)
class SampledLight(PolygonLight):
    """A light without a closed form: narrower than Lambertian, or a mirror image (`synth.render.lights`).

    What of an image arrives depends on the angle at the face of a window of this index.
    """

    narrowness: Any | None
    index: Any | None

    def whole(self, point: Any, normal: Any, nodes: int) -> Any:
        import drjit as dr

        total = self.mi.Vector3f(0)
        for k, (along, weight) in enumerate(zip(*leggauss(nodes), strict=True)):
            place = self.mi.Point2f(0.5 + 0.5 * float(along), 0.5 + (-1) ** k * _ACROSS)
            value = self.sample(point, place)[1]
            total += dr.select(dr.dot(value, normal) > 0, 0.5 * float(weight) * value, 0)
        return total

    def sample(self, point: Any, offset: Any) -> tuple[Any, Any]:
        import drjit as dr

        place, value = super().sample(point, offset)
        away = dr.normalize(place - point)
        if self.narrowness is not None:
            value *= dr.power(dr.maximum(-dr.dot(away, self.front), _LEAST), self.narrowness)
        if self.index is not None:
            value *= reflectance(dr.abs(away.z), self.index, self.mi)
        return place, value


@dataclass(init=False, eq=False)
class LightTable:
    """Lights of one kind, in tables that loops look them up in: kernels do not grow with their number.

    `sampled`: without a closed form; with an `index` they are mirror images behind a window of that index.
    """

    count: Any
    _mi: Any
    _sampled: bool
    _places: list[Any]
    _areas: Any
    _radiance: list[Any]
    _narrowness: Any | None
    _index: Any | None

    def __init__(
        self, lights: Sequence[Light], channels: int, mi: Any, sampled: bool = False, index: float | None = None
    ) -> None:
        import drjit as dr

        self.count, self._mi, self._sampled = dr.opaque(mi.UInt32, len(lights)), mi, sampled
        self._places = [_floats(column, mi) for column in rectangles(tuple(lights)).swapaxes(0, 1)]
        self._areas = _floats([light.size_mm[0] * light.size_mm[1] for light in lights], mi)
        self._radiance = [_floats([light.radiance[channel] for light in lights], mi) for channel in range(channels)]
        narrowness = [light.narrowness for light in lights]
        self._narrowness = _floats(narrowness, mi) if any(narrowness) else None
        self._index = None if index is None else dr.opaque(mi.Float, index)

    @property
    def static(self) -> tuple[bool, ...]:
        """What of the table is compiled into kernels."""
        return self._sampled, self._narrowness is None, self._index is None

    def light(self, number: Any) -> PolygonLight:
        """A light by its number (mi.UInt32)."""
        import drjit as dr

        mi = self._mi
        corner, first, second, front = (dr.gather(mi.Vector3f, places, number) for places in self._places)
        radiance = [dr.gather(mi.Float, values, number) for values in self._radiance]
        shared = (mi, corner, (first, second), front, dr.gather(mi.Float, self._areas, number), radiance)
        if not self._sampled:
            return PolygonLight(*shared)
        narrowness = None if self._narrowness is None else dr.gather(mi.Float, self._narrowness, number)
        return SampledLight(*shared, narrowness, self._index)


def _floats(values: Any, mi: Any) -> Any:
    """Numbers as mi.Float in memory, never as a literal."""
    import drjit as dr

    found = mi.Float(aligned(values))
    dr.make_opaque(found)
    return found


def _edge(a: Any, b: Any) -> Any:
    """θ (a × b) / |a × b| of unit vectors."""
    import drjit as dr

    half = dr.sqrt(dr.maximum(0.5 + 0.5 * dr.dot(a, b), 1e-12))  # cos(θ/2)
    quotient = type(half)(0)
    for coefficient in reversed(_SERIES):
        quotient = dr.fma(quotient, 1 - half, coefficient)
    return quotient / half * dr.cross(a, b)


def _series() -> list[float]:
    """Coefficients of (θ/2) / sin(θ/2) in powers of 1 - cos(θ/2), for 0 <= θ <= π."""
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    values = np.arccos(1 - nodes) / np.sqrt(nodes * (2 - nodes))
    fitted = Chebyshev.fit(nodes, values, _DEGREE, domain=[0, 1]).convert(kind=Polynomial)
    return [float(value) for value in fitted.coef]


_SERIES = _series()
