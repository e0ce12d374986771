"""Tetrahedral meshes by fTetWild (Hu et al., ACM TOG 2020; pytetwild).

What fTetWild leaves to do: its faces are up to epsilon off, so boundary vertices are moved onto the shape that is
meshed; its orientation is negative; and it is not deterministic, so a mesh is made once and cached
(`synth.mesh.cache`).
"""

import contextlib
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from synth.arrays import FloatArray, Points, Projection, Tets, Triangles
from synth.errors import InputError
from synth.mesh.pad import PadMesh, boundary_faces, signed_volumes

GRADING = 2.0
"""Edge length at a box's window over edge length at its contact face."""
ROOM = 1.01
"""Size of a background mesh over the box's: points that rounding puts outside of the box are still in it."""
ENVELOPE = 1e-3
"""fTetWild's epsilon for flat faces, relative to the bounding box's diagonal."""
ON_SIDE_MM = 1e-9
"""Distance from a side at which a vertex lies on it."""
ROUNDS = 50
"""Most rounds in which vertices of several sides are moved onto one side after the other."""
ATTEMPTS = 3
"""Meshes that are made until one is valid; the mesher is random."""
WORST_SHAPE = 0.02
"""Smallest accepted ratio of inscribed to circumscribed radius, times 3 (1 for a regular tetrahedron)."""


@dataclass(frozen=True)
class Background:
    """Target edge lengths (n,) mm for fTetWild at points (n, 3) mm, linear within tetrahedra (m, 4) int32."""

    points: Points
    tets: Tets
    values: FloatArray


def background_of(size_mm: tuple[float, float, float], edge_mm: float, grading: float = 1.0) -> Background:
    """Edges of edge_mm at z = 0 of a bounding box of that size, and linearly up to `grading` times that at its top."""
    corners, _ = _box(size_mm)
    centre = np.array([0.0, 0.0, size_mm[2] / 2])
    points = centre + ROOM * (corners - centre)
    tets = [(0, 1, 3, 7), (0, 3, 2, 7), (0, 2, 6, 7), (0, 6, 4, 7), (0, 4, 5, 7), (0, 5, 1, 7)]
    values = edge_mm * (1 + (grading - 1) * np.clip(points[:, 2] / size_mm[2], 0, 1))
    return Background(points, np.array(tets, dtype=np.int32), values)


def tetrahedralise_box(
    size_mm: tuple[float, float, float], edge_length_mm: float, background: Background | None = None
) -> PadMesh:
    """Mesh a box whose tetrahedra have edges of edge_length_mm at z = 0, its contact face, or as a background says.

    By default edges are GRADING times as long at the window. InputError where no attempt gave a valid mesh.
    """
    background = background or background_of(size_mm, edge_length_mm, GRADING)
    points, tets = tetrahedralise(*_box(size_mm), box_sides(size_mm), background, float(np.prod(size_mm)), 1e-9)
    return PadMesh(points, tets, size_mm)


def tetrahedralise(
    corners: Points,
    faces: Triangles,
    sides: Sequence[Projection],
    background: Background,
    volume_mm3: float | None,
    share: float,
    envelope: float = ENVELOPE,
) -> tuple[Points, Tets]:
    """Mesh what a closed surface encloses, with the vertices of its boundary moved onto the shape that it stands for.

    The surface has corners (n, 3) mm and triangles (m, 3). `sides` are the parts of the shape, each as the projection
    onto it; vertices of two are moved by both in this order. The background gives target edge lengths. The mesh may
    differ from the shape's volume, where that is known, by a share of it. `envelope` is fTetWild's epsilon, relative to
    the bounding box's diagonal.

    Returns points (n, 3) mm and positively oriented tetrahedra (m, 4); InputError where no attempt gave a valid mesh.
    """
    problem = ""
    tolerance = 2 * envelope * float(np.linalg.norm(np.ptp(corners, axis=0)))
    for _ in range(ATTEMPTS):
        points, tets = _repair(*_ftetwild(corners, faces, background, envelope), sides, tolerance)
        problem = _fault(points, tets, sides, volume_mm3, share)
        if not problem:
            return points, tets
    edge_mm = float(background.values.min())
    raise InputError(
        f"no valid mesh of the gel with edge length {edge_mm:.3g} mm in {ATTEMPTS} attempts: {problem}; "
        "try another numerics.edge_length_mm"
    )


def shape_quality(points: Points, tets: Tets) -> np.ndarray:
    """(m,) 3 x inscribed radius / circumscribed radius: 1 for a regular tetrahedron, 0 for a flat one."""
    a, b, c, d = (points[tets[:, i]] for i in range(4))
    volume = np.abs(signed_volumes(points, tets))
    area = sum(
        np.linalg.norm(np.cross(q - p, r - p), axis=1) / 2 for p, q, r in ((a, b, c), (a, b, d), (a, c, d), (b, c, d))
    )
    u, v, w = b - a, c - a, d - a
    numerator = np.linalg.norm(
        (u**2).sum(1)[:, None] * np.cross(v, w)
        + (v**2).sum(1)[:, None] * np.cross(w, u)
        + (w**2).sum(1)[:, None] * np.cross(u, v),
        axis=1,
    )
    return np.asarray(108 * volume**2 / np.maximum(area * numerator, 1e-300))


def _box(size: tuple[float, float, float]) -> tuple[Points, Triangles]:
    half = np.array([size[0] / 2, size[1] / 2])
    corners = np.array([(x, y, z) for z in (0.0, size[2]) for y in (-half[1], half[1]) for x in (-half[0], half[0])])
    quads = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=np.int32)


def box_sides(size: tuple[float, float, float]) -> list[Projection]:
    """Projections onto the planes of a box, the one on the window and then the contact face last."""
    planes = [(axis, side * size[axis] / 2) for axis in (0, 1) for side in (-1, 1)] + [(2, size[2]), (2, 0.0)]
    return [partial(_onto_plane, axis=axis, value=value) for axis, value in planes]


def _onto_plane(points: Points, axis: int, value: float) -> Points:
    moved = points.copy()
    moved[:, axis] = value
    return moved


def _ftetwild(corners: Points, faces: Triangles, background: Background, envelope: float) -> tuple[Points, Tets]:
    import pytetwild

    # fTetWild leaves a __tracked_surface.stl in the working directory.
    with _python_interrupts(), tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch):
        points, tets = pytetwild.tetrahedralize(
            corners,
            faces,
            edge_length_abs=float(background.values.max()),
            epsilon=envelope,
            bg_vertices=background.points,
            bg_tets=background.tets.copy(),  # read-only arrays are refused
            bg_values=background.values,
        )
    return np.asarray(points, dtype=np.float64), np.asarray(tets, dtype=np.int32)


@contextlib.contextmanager
def _python_interrupts() -> Iterator[None]:
    """Python's Ctrl-C again: fTetWild's library sets the system's default, which ends the process without a word."""
    before = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, before)


def _repair(points: Points, tets: Tets, sides: Sequence[Projection], tolerance: float) -> tuple[Points, Tets]:
    """Move boundary vertices onto the shape's sides, drop unused vertices, orient positively."""
    used, renumbered = np.unique(tets, return_inverse=True)
    points, tets = points[used].copy(), renumbered.reshape(tets.shape).astype(np.int32)
    faces = boundary_faces(tets)
    # The side of a boundary face is, of those to which all three of its corners are near, the nearest to its middle.
    near, middles = _distances(points, faces, sides) <= tolerance, points[faces].mean(axis=1)
    away = np.where(near, [np.linalg.norm(middles - side(middles), axis=1) for side in sides], np.inf)
    nearest = np.where(near.any(axis=0), away.argmin(axis=0), -1)
    parts = [(side, np.unique(faces[nearest == number])) for number, side in enumerate(sides)]
    for _ in range(ROUNDS):  # the second and later ones are for sides that are not at right angles
        for side, nodes in parts:
            points[nodes] = side(points[nodes])
        if all(np.abs(points[nodes] - side(points[nodes])).max(initial=0.0) < ON_SIDE_MM for side, nodes in parts):
            break
    flipped = signed_volumes(points, tets) < 0
    tets[flipped] = tets[flipped][:, [0, 2, 1, 3]]
    return points, tets


def _distances(points: Points, faces: Triangles, sides: Sequence[Projection]) -> FloatArray:
    """(s, f) mm by which the farthest corners of faces are off each of the sides."""
    corners = points[faces].reshape(-1, 3)
    return np.array([np.linalg.norm(corners - side(corners), axis=1).reshape(-1, 3).max(axis=1) for side in sides])


def _fault(points: Points, tets: Tets, sides: Sequence[Projection], volume_mm3: float | None, share: float) -> str:
    """What is wrong with a mesh, or an empty string."""
    volumes = signed_volumes(points, tets)
    if volumes.min() <= 0:
        return f"a tetrahedron has volume {volumes.min():.3g} mm^3"
    if volume_mm3 and abs(volumes.sum() / volume_mm3 - 1) > share:  # sums of some 1e4 volumes round to about 1e-13
        return f"the mesh fills {volumes.sum():.9g} of {volume_mm3:.9g} mm^3"
    off = float(_distances(points, boundary_faces(tets), sides).min(axis=0).max())
    if off > ON_SIDE_MM:
        return f"a face of the boundary is {off:.3g} mm off the gel's shape"
    worst = float(shape_quality(points, tets).min())
    if worst < WORST_SHAPE:
        return f"worst tetrahedron has shape quality {worst:.3g} < {WORST_SHAPE}"
    return ""
