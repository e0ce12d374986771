"""Capsules: a layer of gel around a hemisphere and a cylinder, as a shape and as triangles.

With R the outer radius, t the thickness and L the length, the coated face has the distance R from the axis that runs
from (0, 0, R) to (0, 0, R + L), and the window's face the distance R - t; the gel is cut at z = R + L.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points, Projection, Triangles

ROUNDING = 1e-9
"""Distance from a shape, relative to its radius, at which a node lies on it."""


@dataclass(frozen=True)
class CapsuleFace:
    """The shape of a capsule, by R, t and L of the module's docstring, and whether the ring at z = R + L is held."""

    radius_mm: float
    thickness_mm: float
    length_mm: float
    holds_end: bool = False

    @property
    def top_mm(self) -> float:
        return self.radius_mm + self.length_mm

    @property
    def volume_mm3(self) -> float:
        outer, inner = self.radius_mm, self.radius_mm - self.thickness_mm
        return float(np.pi * (2 / 3 * (outer**3 - inner**3) + self.length_mm * (outer**2 - inner**2)))

    def holds(self, points: Points) -> BoolArray:
        return self._has_radius(points, self.radius_mm)

    def bonded(self, points: Points, size_mm: tuple[float, float, float]) -> BoolArray:
        """Which points (n, 3) mm lie on the window, or on an end that is held."""
        inner = self._has_radius(points, self.radius_mm - self.thickness_mm)
        return inner | (points[:, 2] == self.top_mm) if self.holds_end else inner

    def project(self, points: Points) -> Points:
        """Points (n, 3) mm moved onto the coated face, away from the axis."""
        return self._at_radius(points, self.radius_mm)

    @property
    def sides(self) -> list[Projection]:
        """Projections onto the plane of the gel's end, the window's face and the coated face."""
        window = partial(self._at_radius, radius=self.radius_mm - self.thickness_mm)
        return [
            lambda points: np.column_stack([points[:, :2], np.full(len(points), self.top_mm)]),
            window,
            self.project,
        ]

    def __str__(self) -> str:
        return f"capsule with radius_mm = {self.radius_mm}, thickness_mm = {self.thickness_mm}"

    def place(self, polar_deg: float | None, height_mm: float | None, azimuth_deg: float) -> tuple[Points, Points]:
        """A point (3,) mm of the coated face and the unit normal (3,) into the gel there.

        The place is given by the angle at the hemisphere's centre, or by z.
        """
        radius, azimuth = self.radius_mm, np.radians(azimuth_deg)
        if height_mm is not None:
            z, polar = height_mm, np.arccos(max(1 - height_mm / radius, 0.0))
        else:
            polar = np.radians(polar_deg or 0.0)
            z = radius - radius / np.tan(polar) if polar > np.pi / 2 else 0.0
            polar = min(polar, np.pi / 2)
        outward = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), -np.cos(polar)])
        return np.array([0.0, 0.0, max(radius, z)]) + radius * outward, -outward

    def triangles(self, edge_mm: float) -> tuple[Points, Triangles]:
        """The gel's closed boundary as triangles with edges of about edge_mm, their normals pointing out of the gel.

        Their corners lie on rings. Ring i of the hemisphere's m, at a polar angle of 90 i / m degrees, has 4 i, so that
        triangles are about alike all over it; the cylinder's have 4 m each.
        """
        from scipy.spatial import Delaunay

        m, bands = max(4, int(np.ceil(np.pi / 2 * self.radius_mm / edge_mm))), int(np.ceil(self.length_mm / edge_mm))
        ring, step = np.array([(i, k) for i in range(m + bands + 1) for k in range(4 * min(i, m) or 1)]).T
        azimuth, polar = np.pi / 2 * step / np.clip(ring, 1, m), np.pi / 2 * np.minimum(ring, m) / m
        around = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        across, down = np.where(ring < m, (np.sin(polar), np.cos(polar)), ([1.0], [0.0]))
        z = self.radius_mm + self.length_mm * np.maximum(ring - m, 0) / max(bands, 1)
        radii = self.radius_mm, self.radius_mm - self.thickness_mm
        outer, inner = (np.column_stack([r * across[:, None] * around, z - r * down]) for r in radii)
        face = Delaunay(ring[:, None] * around).simplices[:, ::-1]  # rolled out: rings are circles
        last = np.arange(len(outer) - 4 * m, len(outer))
        behind = len(outer) + last
        end = [(last, np.roll(behind, -1), behind), (last, np.roll(last, -1), np.roll(behind, -1))]
        parts = [face, len(outer) + face[:, ::-1], *(np.column_stack(corners) for corners in end)]
        return np.concatenate([outer, inner]), np.concatenate(parts).astype(np.int32)

    def _centres(self, points: Points) -> Points:
        """(n, 3) mm: the nearest points of the axis."""
        z = np.maximum(points[:, 2], self.radius_mm)
        return np.column_stack([np.zeros((len(z), 2)), z])

    def _has_radius(self, points: Points, radius: float) -> BoolArray:
        away: FloatArray = np.linalg.norm(points - self._centres(points), axis=1)
        return np.asarray(np.abs(away - radius) <= ROUNDING * radius)

    def _at_radius(self, points: Points, radius: float) -> Points:
        centres = self._centres(points)
        offset = points - centres
        return np.asarray(centres + offset * (radius / np.linalg.norm(offset, axis=1, keepdims=True)))
