"""Background meshes that carry fTetWild's target edge length: a value per vertex, linear within its tetrahedra."""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Points, Tets
from synth.mesh.focus import Focus
from synth.mesh.graded import kuhn_tets

GRADING = 2.0
"""Without a focus: edge length at the window over edge length at the contact face."""
SLOPE = 0.35
"""With a focus: growth of the target edge length per distance from the zone."""
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
    corners = np.array([(x, y, z) for z in (0, size_mm[2]) for y in (-0.5, 0.5) for x in (-0.5, 0.5)], dtype=float)
    corners[:, :2] *= size_mm[:2]
    centre = np.array([0.0, 0.0, size_mm[2] / 2])
    points = centre + ROOM * (corners - centre)
    tets = np.array(
        [(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)], dtype=np.int32
    )
    return Background(points, tets, edge_mm * (1 + (GRADING - 1) * np.clip(points[:, 2] / size_mm[2], 0, 1)))


def around_focus(size_mm: tuple[float, float, float], edge_mm: float, focus: Focus, coarse_mm: float) -> Background:
    """Edges of edge_mm in the focus at the contact face, SLOPE longer per distance from there, at most coarse_mm."""
    spans = [focus.span(0, size_mm[0]), focus.span(1, size_mm[1]), (0.0, 0.0)]
    lower = (-size_mm[0] / 2, -size_mm[1] / 2, 0.0)
    cell = max((coarse_mm - edge_mm) / SLOPE, edge_mm) / 4
    axes = []
    for low, length, span in zip(lower, size_mm, spans, strict=True):
        even = np.linspace(low, low + length, int(np.ceil(length / cell)) + 1)
        # The ends of the zone are planes of the grid, so that the field is edge_mm right up to them.
        inner = even[np.abs(even[:, None] - span).min(axis=1) > cell / 4]
        axes.append(np.unique(np.concatenate([inner, span, even[[0, -1]]])))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    away = np.stack(
        [np.maximum(np.maximum(low - points[:, k], points[:, k] - high), 0) for k, (low, high) in enumerate(spans)]
    )
    values = np.minimum(edge_mm + SLOPE * np.linalg.norm(away, axis=0), coarse_mm)
    for k, length in enumerate(size_mm):
        for face in (lower[k], lower[k] + length):
            points[points[:, k] == face, k] += (ROOM - 1) * (face - lower[k] - length / 2)
    return Background(points, kuhn_tets(*(len(planes) - 1 for planes in axes)), values)
