"""Smooth normals of a deformed surface."""

import numpy as np

from synth.arrays import Points, Triangles


def vertex_normals(positions: Points, triangles: Triangles) -> Points:
    """Unit normals at vertices: the mean of the adjoining triangles' normals, weighted by area, as rendered.

    Args:
        positions: (v, 3) float64 mm.
        triangles: (f, 3) int32, every vertex used by at least one.

    Returns:
        (v, 3) float64, on the side to which the triangles are oriented (right-hand rule on the components).
    """
    a, b, c = (positions[corner] for corner in triangles.T)
    weighted = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = np.column_stack([np.bincount(triangles.ravel(), w, len(positions)) for w in weighted.T])
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
