"""Nearest hits of rays with a triangle surface, in float64 and deterministic, by Warp kernels.

The surface's triangles are binned into the cells of a grid over x and y, each into every cell that its bounding box
(widened by far more than rounding) touches. Inside the gel a ray is straight, so it visits the cells under its track
one after the other (Amanatides & Woo 1987) from where it enters the slab of z that the surface occupies, tests the
triangles of each (Möller & Trumbore 1997) and stops at the first cell that holds its nearest hit. Cells above whose
highest triangle it still is are passed without a test.

Edges belong to both their triangles: barycentric coordinates down to -1e-9 count as inside, which is far above the
rounding of the test (about 1e-13) and far below anything visible, so no ray falls through between two triangles. Of
several hits the nearest counts, and of equally near ones the triangle of lowest index: an order that does not depend on
that in which triangles are met, so results are the same in every run. Edge-on triangles are never hit themselves; their
neighbours' edges are.
"""

from typing import Any

import numpy as np
import warp as wp

from synth.arrays import Points, Triangles
from synth.flow.hits import Hits, as_warp

wp.config.log_level = wp.LOG_WARNING
wp.set_module_options({"enable_backward": False})

_TRIANGLES_PER_CELL = 0.25
"""Cells are as large as so many triangles are on average. It changes the time and no bit of a result."""


def trace(positions: Points, triangles: Triangles, origins: Points, directions: Points) -> Hits:
    """Find where rays first meet a surface.

    Args:
        positions: (v, 3) float64 mm.
        triangles: (f, 3) int32 into `positions`.
        origins: (n, 3) float64 mm; NaN for rays that do not exist.
        directions: (n, 3) unit, with a negative z: rays go toward the contact surface.

    Returns:
        Hits of the n rays. They start at their origin: what lies behind it is not hit.
    """
    rays = len(origins)
    outputs = [wp.empty(rays, dtype=kind, device="cpu") for kind in (wp.int32, wp.vec3d, wp.float64)]
    vertices = as_warp(positions, np.float64, wp.vec3d)
    corners = as_warp(triangles, np.int32, wp.int32)
    cells = _grid_around(positions, len(triangles))
    bins = _bin(cells, vertices, corners)
    rays_given = [as_warp(array, np.float64, wp.vec3d) for array in (origins, directions)]
    inputs = [cells, vertices, corners, *bins, *rays_given]
    wp.launch(_nearest_hit, dim=rays, inputs=inputs, outputs=outputs, device="cpu")
    return Hits(*(array.numpy() for array in outputs))


@wp.struct
class _Cells:
    """A grid over x and y, and the slab of z in which all triangles lie."""

    x: wp.float64
    y: wp.float64
    size: wp.float64
    margin: wp.float64
    bottom: wp.float64
    top: wp.float64
    columns: wp.int32
    rows: wp.int32


def _grid_around(positions: Points, triangles: int) -> Any:
    cells = _Cells()
    low, high = positions.min(axis=0), positions.max(axis=0)
    extent = high - low
    cells.margin = margin = 1e-9 * float(extent.max())  # coordinates round at about 1e-16 of the extent
    low, high = low - 2 * margin, high + 2 * margin
    area = max(float(extent[0] * extent[1]), 1e-6 * float(extent[:2].max()) ** 2)
    cells.size = size = float(np.sqrt(_TRIANGLES_PER_CELL * area / triangles))
    cells.x, cells.y, cells.bottom, cells.top = low[0], low[1], low[2], high[2]
    cells.columns, cells.rows = (int(np.ceil((high - low)[axis] / size)) for axis in (0, 1))
    return cells


def _bin(cells: Any, vertices: Any, corners: Any) -> tuple[Any, Any, Any]:
    """Triangles of each cell: starts of the cells' lists (one more than cells), the lists, and their tops."""
    number = cells.rows * cells.columns
    count = wp.zeros(number + 1, dtype=wp.int32, device="cpu")
    ceiling = wp.full(number, -np.inf, dtype=wp.float64, device="cpu")
    inputs, triangles = [cells, vertices, corners], corners.shape[0]
    wp.launch(_count, dim=triangles, inputs=inputs, outputs=[count, ceiling], device="cpu")
    first = wp.empty_like(count)
    wp.utils.array_scan(count, first, inclusive=False)
    members = wp.empty(int(first.numpy()[-1]), dtype=wp.int32, device="cpu")
    taken = wp.clone(first)
    wp.launch(_fill, dim=triangles, inputs=inputs, outputs=[taken, members], device="cpu")
    return first, members, ceiling


@wp.func
def _column(cells: _Cells, x: wp.float64) -> wp.int32:
    return wp.clamp(wp.int32(wp.floor((x - cells.x) / cells.size)), 0, cells.columns - 1)


@wp.func
def _row(cells: _Cells, y: wp.float64) -> wp.int32:
    return wp.clamp(wp.int32(wp.floor((y - cells.y) / cells.size)), 0, cells.rows - 1)


@wp.func
def _touched(cells: _Cells, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec4i:
    """First and last column, first and last row that a triangle's widened bounding box touches."""
    return wp.vec4i(
        _column(cells, wp.min(wp.min(a[0], b[0]), c[0]) - cells.margin),
        _column(cells, wp.max(wp.max(a[0], b[0]), c[0]) + cells.margin),
        _row(cells, wp.min(wp.min(a[1], b[1]), c[1]) - cells.margin),
        _row(cells, wp.max(wp.max(a[1], b[1]), c[1]) + cells.margin),
    )


@wp.kernel
def _count(
    cells: _Cells,
    vertices: wp.array[wp.vec3d],
    corners: wp.array2d[wp.int32],
    count: wp.array[wp.int32],
    ceiling: wp.array[wp.float64],
) -> None:
    """How many triangles every cell holds, and how far up they reach."""
    t = wp.tid()
    a, b, c = vertices[corners[t, 0]], vertices[corners[t, 1]], vertices[corners[t, 2]]
    span = _touched(cells, a, b, c)
    top = wp.max(wp.max(a[2], b[2]), c[2]) + wp.float64(4.0) * cells.margin
    for row in range(span[2], span[3] + 1):
        for column in range(span[0], span[1] + 1):
            cell = row * cells.columns + column
            wp.atomic_add(count, cell, 1)
            wp.atomic_max(ceiling, cell, top)


@wp.kernel
def _fill(
    cells: _Cells,
    vertices: wp.array[wp.vec3d],
    corners: wp.array2d[wp.int32],
    taken: wp.array[wp.int32],
    members: wp.array[wp.int32],
) -> None:
    t = wp.tid()
    span = _touched(cells, vertices[corners[t, 0]], vertices[corners[t, 1]], vertices[corners[t, 2]])
    for row in range(span[2], span[3] + 1):
        for column in range(span[0], span[1] + 1):
            place = wp.atomic_add(taken, row * cells.columns + column, 1)
            members[place] = t


@wp.func
def _intersect(o: wp.vec3d, d: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec4d:
    """Distance and barycentric coordinates; the distance is negative where the triangle is not hit."""
    miss = wp.vec4d(wp.float64(-1.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    tolerance = wp.float64(-1e-9)
    ab, ac, ao = b - a, c - a, o - a
    normal = wp.cross(ab, ac)
    slant = -wp.dot(d, normal)
    moment = wp.cross(ao, d)
    v = wp.dot(ac, moment) / slant
    if v < tolerance:
        return miss
    w = -wp.dot(ab, moment) / slant
    u = wp.float64(1.0) - v - w
    if w < tolerance or u < tolerance or wp.abs(slant) <= wp.float64(1e-12) * wp.length(normal):
        return miss
    return wp.vec4d(wp.dot(ao, normal) / slant, u, v, w)


@wp.kernel
def _nearest_hit(
    cells: _Cells,
    vertices: wp.array[wp.vec3d],
    corners: wp.array2d[wp.int32],
    first: wp.array[wp.int32],
    members: wp.array[wp.int32],
    ceiling: wp.array[wp.float64],
    origins: wp.array[wp.vec3d],
    directions: wp.array[wp.vec3d],
    triangle: wp.array[wp.int32],
    barycentric: wp.array[wp.vec3d],
    distance: wp.array[wp.float64],
) -> None:
    ray = wp.tid()
    o, d = origins[ray], directions[ray]
    infinite = wp.float64(wp.inf)
    nearest, weights, found = infinite, wp.vec3d(wp.float64(wp.nan)), wp.int32(-1)
    if d[2] < wp.float64(0.0):
        enter = wp.max((cells.top - o[2]) / d[2], wp.float64(0.0))
        leave = (cells.bottom - o[2]) / d[2]
        p = o + enter * d
        column = wp.int32(wp.floor((p[0] - cells.x) / cells.size))
        row = wp.int32(wp.floor((p[1] - cells.y) / cells.size))
        step_x, step_y = wp.int32(1), wp.int32(1)
        if d[0] < wp.float64(0.0):
            step_x = wp.int32(-1)
        if d[1] < wp.float64(0.0):
            step_y = wp.int32(-1)
        at = enter
        while at <= leave:
            # Where the ray crosses the sides of this cell that lie ahead of it.
            next_x, next_y = infinite, infinite
            if d[0] != wp.float64(0.0):
                next_x = (cells.x + wp.float64(column + wp.max(step_x, 0)) * cells.size - o[0]) / d[0]
            if d[1] != wp.float64(0.0):
                next_y = (cells.y + wp.float64(row + wp.max(step_y, 0)) * cells.size - o[1]) / d[1]
            exit = wp.min(next_x, next_y)
            if column >= 0 and column < cells.columns and row >= 0 and row < cells.rows:
                cell = row * cells.columns + column
                end = first[cell + 1]
                if o[2] + exit * d[2] > ceiling[cell]:  # leaves the cell above all of its triangles
                    end = first[cell]
                for k in range(first[cell], end):
                    t = members[k]
                    hit = _intersect(o, d, vertices[corners[t, 0]], vertices[corners[t, 1]], vertices[corners[t, 2]])
                    if hit[0] >= wp.float64(0.0) and (hit[0] < nearest or (hit[0] == nearest and t < found)):
                        nearest, weights, found = hit[0], wp.vec3d(hit[1], hit[2], hit[3]), t
            if nearest <= exit:
                break
            at = exit
            if next_x <= next_y:
                column += step_x
            else:
                row += step_y
    triangle[ray] = found
    barycentric[ray] = weights
    distance[ray] = nearest
