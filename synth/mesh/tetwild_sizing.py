"""Background meshes that carry fTetWild's target edge length: a value per vertex, linear within its tetrahedra."""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Points, Tets

GRADING = 2.0
"""Edge length at the window over edge length at the contact face."""
ROOM = 1.01
"""A background covers the box with room to spare, for points that rounding puts outside."""


@dataclass(frozen=True)
class Background:
    """A piecewise linear field of target edge lengths.

    Attributes:
        points: (n, 3) float64 mm.
        tets: (m, 4) int32.
        values: (n,) float64 mm.
    """

    points: Points
    tets: Tets
    values: FloatArray


def through_thickness(size_mm: tuple[float, float, float], edge_mm: float) -> Background:
    """Edges of edge_mm at the contact face, GRADING times that at the window."""
    points, tets = _around(size_mm)
    return Background(points, tets, edge_mm * (1 + (GRADING - 1) * np.clip(points[:, 2] / size_mm[2], 0, 1)))


def even(size_mm: tuple[float, float, float], edge_mm: float) -> Background:
    """Edges of edge_mm everywhere in a gel whose bounding box is of that size."""
    points, tets = _around(size_mm)
    return Background(points, tets, np.full(len(points), edge_mm))


def _around(size_mm: tuple[float, float, float]) -> tuple[Points, Tets]:
    """A box with room to spare, as six tetrahedra."""
    corners = np.array([(x, y, z) for z in (0, size_mm[2]) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], dtype=float)
    corners[:, :2] *= size_mm[:2]
    centre = np.array([0.0, 0.0, size_mm[2] / 2])
    points = centre + ROOM * (corners - centre)
    tets = np.array(
        [(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)], dtype=np.int32
    )
    return points, tets
