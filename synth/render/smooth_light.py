r"""Light from far away on a gel, fitted to samples of it: what its window sends back, what a round one sends itself.

A point x of the face with the normal n gets, from directions ω in which it sees the radiance L,

.. math::  E = \int L(ω) \max(n · ω, 0) \, dω = n · V(x), \qquad V(x) = \int L(ω) \, ω \, dω ,

where all of that light comes from above the point's horizon: nearly so from a window, exactly so in a convex cavity,
nearly so where a contact bulges into it. V is smooth after so long a path: its components are polynomials of the place,
of least squares for the irradiance sampled on faces. The least squares depend on the geometry alone; they are solved on
the host before anything is sampled, so that what is sampled stays on the device.
"""

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray, Points, Triangles
from synth.render.aligned import aligned
from synth.render.gel_mesh import GelMesh
from synth.render.lights import reflecting_plane
from synth.scene import RoundGel, Sensor

_DEGREE = 4
"""Degree of V's polynomials."""
_R2 = (0.7548776662466927, 0.5698402909980532)
"""Steps of the R2 sequence."""
_RETURNING_NODES = 1024
"""Points at which light that comes back from the window is sampled."""
_CLEARANCE_MM = 1e-3
"""Height above the gel's highest point at which rays end that look for gel alone: far more than rounding."""
_RANK = 1e-14
"""Relative eigenvalue below which directions are not fitted: on flat gel, those of V along it."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Points of a surface at which light is sampled: their faces (n,), and weights (n, 3) of the faces' corners."""

    faces: NDArray[np.intp]
    weights: FloatArray

    @staticmethod
    def spread(positions: Points, triangles: Triangles, count: int) -> "Nodes":
        """`count` points spread evenly over the area, at low-discrepancy places of their faces (R2, Roberts 2018)."""
        a, b, c = (positions[corner] for corner in triangles.T)
        area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
        faces = np.searchsorted(area, (np.arange(count) + 0.5) / count * area[-1])
        u, v = np.outer(_R2, np.arange(1, count + 1)) % 1
        root = np.sqrt(u)
        return Nodes(faces, np.column_stack([1 - root, root * (1 - v), root * v]))

    @staticmethod
    def centres(triangles: Triangles) -> "Nodes":
        """The middle of each face."""
        return Nodes(np.arange(len(triangles)), np.full((len(triangles), 3), 1 / 3))

    def numbers(self, mi: Any) -> tuple[Any, list[Any]]:
        """Faces (mi.UInt32) and weights (3 of mi.Float) on the device."""
        weights = [mi.Float(aligned(column)) for column in self.weights.T]
        return mi.UInt32(aligned(self.faces, np.uint32)), weights


class SmoothFit:
    """The fit at nodes of a surface with vertices at positions (v, 3) mm, whose faces' normals point out of the gel.

    Places count in the first axes of a box from `low` to `high` mm. A Dr.Jit PyTree by `numbers`.
    """

    def __init__(
        self, positions: Points, triangles: Triangles, nodes: Nodes, low: FloatArray, high: FloatArray
    ) -> None:
        corners = positions[triangles[nodes.faces]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        self._centre, self._half = (low + high) / 2, (high - low) / 2
        points = np.einsum("nk,nkc->nc", nodes.weights, corners)[:, : len(low)]
        design = np.stack(_terms(list(((points - self._centre) / self._half).T), list(normals.T)))
        self._solution = np.linalg.pinv(design @ design.T, rcond=_RANK, hermitian=True) @ design

    def numbers(self, mi: Any) -> dict[str, Any]:
        """What `fitted` needs, on the device."""
        import drjit as dr

        centre, half = ([dr.opaque(mi.Float, float(x)) for x in of] for of in (self._centre, self._half))
        return {"solution": mi.Float(aligned(self._solution)), "centre": centre, "half": half}


class FrameGeometry:
    """How a gel lies in one frame, as `SeparatedLight.prepare` needs it.

    `positions` are (v, 3) mm of the mesh's vertices. A plane sends itself no light.
    """

    def __init__(self, sensor: Sensor, mesh: GelMesh, positions: Points, is_deep: bool) -> None:
        placed = mesh.positions(positions).reshape(-1, 3).astype(np.float64)
        faces = mesh.faces().reshape(-1, 3).astype(np.int32)
        low, high = placed.min(axis=0), placed.max(axis=0)
        self.top = float(high[2]) + _CLEARANCE_MM
        self.sizes = len(placed), len(faces)
        self.bounces = is_deep and bool(high[2] - low[2] > _CLEARANCE_MM)
        self.cavity, self.window, self.returning = None, None, None
        if self.bounces and isinstance(sensor.gel, RoundGel):
            self.cavity = SmoothFit(placed, faces, Nodes.centres(faces), low, high)
        if is_deep and reflecting_plane(sensor) is not None:
            half = np.array(sensor.gel.size_mm[:2]) / 2
            self.returning = Nodes.spread(placed, faces, _RETURNING_NODES)
            self.window = SmoothFit(placed, faces, self.returning, -half, half)

    def numbers(self, seed: int, mi: Any) -> dict[str, Any]:
        """The frame's numbers on the device, with three seeds."""
        import drjit as dr

        return {
            "seeds": [dr.opaque(mi.UInt32, (seed + part) % 2**32) for part in range(3)],
            "top": dr.opaque(mi.Float, self.top),
            "cavity": self.cavity and self.cavity.numbers(mi),
            "window": self.window and self.window.numbers(mi),
            "returning": self.returning and self.returning.numbers(mi),
        }


def fitted(fit: dict[str, Any], samples: list[Any], positions: Any, normals: Any, mi: Any) -> list[Any]:
    """Irradiance (channels of mi.Float) of vertices, from its means (channels of n of mi.Float) at the fit's nodes.

    Positions and unit normals of the vertices are mi.Point3f and mi.Vector3f, in the frame of the fit's.
    """
    import drjit as dr

    count = dr.width(samples[0])
    width = dr.width(fit["solution"])
    index = dr.arange(mi.UInt32, width) % dr.opaque(mi.UInt32, count)
    products = [fit["solution"] * dr.gather(mi.Float, sample, index) for sample in samples]
    dr.eval(products)
    found = [dr.block_sum(product, count) for product in products]
    dr.eval(found)
    axes = zip(positions, fit["centre"], fit["half"], strict=False)
    terms = _terms([(x - centre) / half for x, centre, half in axes], list(normals))
    values = [mi.Float(0) for _ in samples]
    for number, term in enumerate(terms):
        at = mi.UInt32(number)
        values = [dr.fma(dr.gather(mi.Float, one, at), term, value) for one, value in zip(found, values, strict=True)]
    return [dr.maximum(value, 0) for value in values]


def _terms(places: list[Any], normals: list[Any]) -> list[Any]:
    """Monomials of places up to the degree, times each component of the normals; of NumPy's arrays or Dr.Jit's."""
    powers = [power for power in product(range(_DEGREE + 1), repeat=len(places)) if sum(power) <= _DEGREE]
    found = []
    for power in powers:
        monomial: Any = 1.0
        for place, exponent in zip(places, power, strict=True):
            for _ in range(exponent):
                monomial = monomial * place
        found += [normal * monomial for normal in normals]
    return found
