"""Inputs that no scene file can hold: bad meshes of the pad and bad files of a mesh indenter."""

from pathlib import Path

import numpy as np

from synth.arrays import Points, Tets
from synth.errors import InputError
from synth.mesh import PadMesh
from synth.mesh.pad import boundary_faces, signed_volumes
from synth.stress.cases import MeshVariant, SurfaceVariant

SLIVER = 1e-3
"""What is left of a sliver's height."""
FLIPPED = [0, 2, 1, 3]
"""Order of a tetrahedron's corners that turns it inside out."""
NEAR = 1e-5
"""Distance of a sliver triangle's third corner from its opposite edge, relative to that edge."""

ROUNDING = 1e-12
"""Relative to a volume: a flat tetrahedron's comes out as some 1e-16 of either sign."""


def altered_mesh(mesh: PadMesh, variant: MeshVariant) -> PadMesh:
    """A pad's mesh with one thing wrong; may refuse (InputError) as any maker of a mesh may."""
    points, tets, size = mesh.points.copy(), mesh.tets.copy(), mesh.size_mm
    largest = int(np.argmax(signed_volumes(points, tets)))
    match variant:
        case "sliver":
            points = _flattened(points, tets, SLIVER)
        case "flat":
            points = _flattened(points, tets, 0.0)
        case "one inverted":
            tets[largest] = tets[largest][FLIPPED]
        case "all inverted":
            tets = np.ascontiguousarray(tets[:, FLIPPED])
        case "nan":
            points[tets[largest, 0], 0] = np.nan
        case "loose node":
            points = np.concatenate([points, [[0.0, 0.0, size[2] / 2]]])
        case "another pad":
            size = (size[0] + 1.0, size[1], size[2])
            points[:, 0] *= size[0] / mesh.size_mm[0]
    return PadMesh(points, tets, size)


def _flattened(points: Points, tets: Tets, share: float) -> Points:
    """Move one inner node toward the opposite face of one of its tetrahedra until `share` of the height is left.

    The first pair is taken for which no other tetrahedron is turned inside out (one may be flattened with it).
    """
    volumes = signed_volumes(points, tets)
    outside = np.zeros(len(points), dtype=bool)
    outside[boundary_faces(tets)] = True
    for tet, corner in np.argwhere(~outside[tets]):
        node = tets[tet, corner]
        centre = points[np.delete(tets[tet], corner)].mean(axis=0)
        moved = points.copy()
        moved[node] = centre + share * (points[node] - centre)
        star = (tets == node).any(axis=1)
        if (signed_volumes(moved, tets[star]) >= (0.1 * share - ROUNDING) * volumes[star]).all():
            return moved
    raise InputError("the pad's mesh has no inner node that could be moved to make a sliver; use a finer mesh")


def write_surface(variant: SurfaceVariant, path: Path, radius_mm: float = 3.0) -> None:
    """A ball as a file of triangles (PLY), as it should be or with one thing wrong; or a pane that stands upright."""
    import pyvista as pv

    ball = pv.Icosphere(radius=radius_mm, nsub=3)
    points, faces = np.asarray(ball.points, dtype=np.float64), ball.regular_faces.copy()
    match variant:
        case "inside out":
            faces = faces[:, ::-1]
        case "mixed":
            faces[::3] = faces[::3, ::-1]
        case "slivers":
            points, faces = _slivers(points, faces)
        case "open":
            faces = faces[7:]
        case "metres":
            points = points / 1000
        case "pane":
            box = pv.Box((-3.0, 3.0, -0.03, 0.03, -2.0, 2.0)).triangulate()
            points, faces = np.asarray(box.points, dtype=np.float64), box.regular_faces
    pv.PolyData.from_regular_faces(points, faces).save(path, recompute_normals=False)  # which would turn them back


def _slivers(points: Points, faces: np.ndarray) -> tuple[Points, np.ndarray]:
    """Split every tenth triangle from a point within it, NEAR its first edge."""
    split = np.arange(0, len(faces), 10)
    a, b, c = faces[split].T
    added = len(points) + np.arange(len(split))
    inside = (1 - NEAR) * (points[a] + points[b]) / 2 + NEAR * points[c]
    parts = [np.column_stack(part) for part in ((a, b, added), (b, c, added), (c, a, added))]
    return np.concatenate([points, inside]), np.concatenate([np.delete(faces, split, axis=0), *parts])
