"""Contours of sampled functions that keep their edges: dual contouring (Ju, Losasso, Schaefer & Warren 2002).

A cell that the contour passes through holds one vertex: the point that is nearest, in the least squares sense, to the
tangent planes where the contour crosses the cell's edges. Those planes come from the function itself, so that a plane
stays plane, and the vertices of cells that an edge or a corner lies in are on it.
"""

from collections.abc import Callable

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points
from synth.scene.surface_file import Triangles

FLAT = 0.05
"""Directions in which the planes' normals vary less, as a share of the largest eigenvalue, do not place a vertex."""
OUTSIDE = 1.0
"""Cells that a vertex may lie outside its own: there are tips that cross no edge of the cell that they end in."""
Planes = Callable[[Points], tuple[FloatArray, Points]]
"""Values (n,) mm and unit gradients (n, 3) of a distance function at points (n, 3)."""


def sharp_contour(values: FloatArray, corner: FloatArray, spacing: float, planes: Planes) -> Triangles:
    """The surface on which a function is zero: triangles without regard to orientation, open where it leaves the grid.

    The samples (i, j, k) are negative inside, the first lies at `corner` (3,) mm, and their spacing is in mm. `planes`
    is the function itself: where its value at a crossing is larger than the spacing the samples hold a jump (a hole
    that was closed, the border of a part), and the plane lies across the cell's edge.
    """
    inside = values <= 0
    places, beyond, axes = crossings(inside)
    if len(places) == 0:
        return Triangles(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), True)
    along = beyond - places
    here, there = (values[tuple(at.T)] for at in (places, beyond))
    points = corner + spacing * (places + (here / (here - there))[:, None] * along)
    value, normal = planes(points)
    smooth = np.abs(value) < spacing
    normal = np.where(smooth[:, None], normal, along)
    points = points - np.where(smooth, value, 0.0)[:, None] * normal
    cells = _cells_around(places, axes)
    whole = ((cells >= 0) & (cells < np.array(values.shape) - 1)).all(axis=2)
    edge, around = np.nonzero(whole)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(np.maximum(cells, 0), 2, 0)), values.shape, mode="clip")
    found, vertex = np.unique(numbers[edge, around], return_inverse=True)
    lower = corner + spacing * np.column_stack(np.unravel_index(found, values.shape))
    vertices = _nearest_to_planes(points[edge], normal[edge], vertex, len(found))
    vertices = np.clip(vertices, lower - OUTSIDE * spacing, lower + (1 + OUTSIDE) * spacing)
    quads = np.full(whole.shape, -1)
    quads[edge, around] = vertex
    quads = quads[np.all(whole, axis=1)]
    return Triangles(vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]), True)


def crossings(inside: BoolArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper ends (n, 3) and axes (n,) of the grid's edges that the contour crosses."""
    parts: list[np.ndarray] = [np.argwhere(np.diff(inside, axis=axis)) for axis in range(3)]
    places, axes = np.concatenate(parts), np.repeat(np.arange(3), [len(part) for part in parts])
    return places, places + np.eye(3, dtype=np.int64)[axes], axes


def _cells_around(places: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(n, 4, 3) the cells around edges, in turn."""
    unit = np.eye(3, dtype=np.int64)
    b, c = unit[(axes + 1) % 3], unit[(axes + 2) % 3]
    return np.stack([places, places - b, places - b - c, places - c], axis=1)


def _nearest_to_planes(points: Points, normals: Points, cell: np.ndarray, count: int) -> Points:
    """(count, 3) per cell the point nearest to its planes, and of all such points that nearest to their mean."""
    size = np.bincount(cell, minlength=count)

    def total(values: FloatArray) -> FloatArray:
        columns = values.reshape(len(values), -1).T
        sums = np.column_stack([np.bincount(cell, weights=column, minlength=count) for column in columns])
        return np.asarray(sums, dtype=np.float64).reshape(count, *values.shape[1:])

    mean = total(points) / size[:, None]
    offset = np.einsum("na,na->n", normals, points - mean[cell])
    width, axes = np.linalg.eigh(total(normals[:, :, None] * normals[:, None, :]))
    with np.errstate(divide="ignore"):
        inverse = np.where(width > FLAT * width[:, -1:], 1 / width, 0.0)
    right = total(normals * offset[:, None])
    return np.asarray(mean + np.einsum("cak,ck,cbk,cb->ca", axes, inverse, axes, right))
