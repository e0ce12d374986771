r"""How the texture is laid on the undeformed face: along z, or about the axis of a round gel.

About the axis, the texture's place is the arc s from the tip along a meridian, in the direction of the azimuth φ,

.. math::  (x, y) = s\,(\cos φ, \sin φ),

which has no seam and is smooth at the tip. The face is taken to be a hemisphere about (0, 0, R) and a cylinder above
it. The chart is true along the meridians and at the tip, and s / ρ too wide across, ρ being the distance from the axis:
marks are therefore painted by their distances in space (`synth.render.marks`).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from synth.arrays import FloatArray, Pixels, Points
from synth.mesh import face_of
from synth.mesh.cad import CadFace
from synth.scene import NoPattern, Sensor


@dataclass(frozen=True)
class FlatChart:
    """A texture laid on along z: places are x and y. It spans `size_mm` about the origin."""

    size_mm: tuple[float, float]

    def flattened(self, material: Points) -> Pixels:
        """Places (n, 2) mm in the texture of points (n, 3) mm of the undeformed face."""
        return material[:, :2]


@dataclass(frozen=True)
class RoundChart:
    """A texture laid on about the axis; `radius` mm of hemisphere and cylinder, `top` z mm of the gel's upper end."""

    radius: float
    top: float

    @property
    def end(self) -> float:
        """Arc mm from the tip to the upper end."""
        return float(self.arc(np.array(self.top)))

    @property
    def size_mm(self) -> tuple[float, float]:
        return 2 * self.end, 2 * self.end

    def arc(self, z: FloatArray) -> FloatArray:
        """Arcs mm from the tip to heights z mm on the face."""
        angle = np.arccos(np.clip(1 - z / self.radius, 0, 1))
        return np.asarray(self.radius * angle + np.maximum(z - self.radius, 0))

    def across(self, arc: FloatArray) -> FloatArray:
        """Distances mm from the axis at arcs mm."""
        return np.asarray(self.radius * np.sin(np.minimum(arc / self.radius, np.pi / 2)))

    def flattened(self, material: Points) -> Pixels:
        """Places (n, 2) mm in the texture of points (n, 3) mm of the undeformed face."""
        across, z = np.hypot(material[:, 0], material[:, 1]), material[:, 2]
        arc = self.radius * np.arctan2(across, np.maximum(self.radius - z, 0)) + np.maximum(z - self.radius, 0)
        return material[:, :2] * np.divide(arc, across, out=np.ones_like(arc), where=across > 0)[:, None]

    def points(self, arc: FloatArray, azimuth: FloatArray) -> FloatArray:
        """Points (..., 3) mm of the face at arcs and azimuths (...,)."""
        across = self.across(arc)
        z = self.radius * (1 - np.cos(np.minimum(arc / self.radius, np.pi / 2)))
        z = z + np.maximum(arc - self.radius * np.pi / 2, 0)
        return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=-1)


Chart = FlatChart | RoundChart
_ROWS = 64
"""Rows of texels that are looked up at a time, which bounds memory."""


def chart_of(sensor: Sensor) -> Chart:
    """How the pattern of a sensor lies on its contact face."""
    x, y, top = sensor.gel.size_mm
    if isinstance(sensor.pattern, NoPattern) or getattr(sensor.pattern, "placing", "z") == "z":
        return FlatChart((x, y))
    return RoundChart(x / 2, top)


def texture_coordinates(sensor: Sensor, folder: Path, x: FloatArray, y: FloatArray) -> FloatArray:
    """(rows, columns, 2) u and v of a gel's file at texel centres x (columns,) and y (rows,) mm; NaN beside the face.

    Each texel looks from outside at the axis, or at the hemisphere's centre. InputError as for `CadFace.textured`.
    """
    from synth.flow.trace import trace

    chart, face = cast(RoundChart, chart_of(sensor)), cast(CadFace, face_of(sensor.gel, folder))
    points, triangles, places = face.textured()
    found = []
    for strip in np.array_split(y, -(-len(y) // _ROWS)):
        across, down = (axis.ravel() for axis in np.meshgrid(x, strip))
        on = chart.points(np.hypot(across, down), np.arctan2(down, across))
        outward = (on - np.maximum(on, chart.radius) * (0.0, 0.0, 1.0)) / chart.radius
        hits = trace(points, triangles, on + 2 * chart.end * outward, -outward)
        found.append(hits.interpolate(triangles, places))
    return np.concatenate(found).reshape(len(y), len(x), 2)
