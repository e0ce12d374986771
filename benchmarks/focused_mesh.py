"""fTetWild's target edge lengths that grow away from a zone of the contact face, for comparison with graded meshes."""

import numpy as np

from synth.mesh import Focus
from synth.mesh.graded import kuhn_tets
from synth.mesh.tetrahedralise import ROOM, Background

SLOPE = 0.35
"""Growth of the target edge length per distance from the zone."""


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
