"""The contact face of a gel at rest by itself, without a mesh of the gel."""

from pathlib import Path

import numpy as np

from synth.arrays import Points, Triangles
from synth.mesh.cad import CadFace
from synth.mesh.capsule import CapsuleFace
from synth.mesh.face import face_height, face_of
from synth.scene import Gel
from synth.surface import FACE_EDGES, ContactFaces, GelSurface

REST_CELLS = 24
"""Squares of the undeformed face along its longer side; triangles along a round gel's diameter."""
PARTS = 3
"""Parts of the edges of those triangles that are curved."""


def rest_surface(gel: Gel, folder: Path = Path()) -> GelSurface:
    """The undeformed contact face of a gel, in quadratic triangles where it is curved; its files are in `folder`.

    Light that varies smoothly is linear on each triangle. The surface does not depend on the meshes of trajectories, so
    that neither does the picture of a sensor at rest.
    """
    face = face_of(gel, folder)
    if isinstance(face, CapsuleFace):
        return capsule_surface(face, gel.size_mm[0] / REST_CELLS)
    if isinstance(face, CadFace):
        coated = face.surfaces.face
        return _curved(face, np.asarray(coated.points, float), coated.regular_faces)
    x, y = gel.size_mm[0] / 2, gel.size_mm[1] / 2
    if gel.dome_radius_mm is None:
        corners_of_pad = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
        return GelSurface(ContactFaces(corners_of_pad, np.array([[0, 2, 1], [0, 3, 2]], dtype=np.int32)), REST_CELLS)
    cell = 2 * max(x, y) / REST_CELLS
    columns, rows = int(np.ceil(2 * x / cell)), int(np.ceil(2 * y / cell))
    # Every second line of the grid holds mid-edge nodes.
    across, down = np.linspace(-x, x, 2 * columns + 1), np.linspace(-y, y, 2 * rows + 1)
    places = np.stack(np.meshgrid(across, down, indexing="ij"), axis=-1).reshape(-1, 2)
    number = np.arange(len(places)).reshape(len(across), len(down))
    i, j = np.meshgrid(np.arange(0, 2 * columns, 2), np.arange(0, 2 * rows, 2), indexing="ij")
    faces = []
    for corners in (((0, 0), (2, 2), (2, 0)), ((0, 0), (0, 2), (2, 2))):
        middles = [tuple((corners[a][k] + corners[b][k]) // 2 for k in (0, 1)) for a, b in FACE_EDGES]
        faces.append(np.stack([number[i + a, j + b].ravel() for a, b in (*corners, *middles)], axis=1))
    nodes = np.column_stack([places, face_height(places, gel.dome_radius_mm)])
    used, renumbered = np.unique(np.concatenate(faces), return_inverse=True)
    return GelSurface(ContactFaces(nodes[used], renumbered.reshape(-1, 6).astype(np.int32)), PARTS)


def capsule_surface(face: CapsuleFace, edge_mm: float) -> GelSurface:
    """The coated face of a capsule as quadratic triangles with edges of about that length."""
    points, triangles = face.triangles(edge_mm)
    return _curved(face, points, triangles[face.holds(points)[triangles].all(axis=1)])


def _curved(face: CapsuleFace | CadFace, points: Points, triangles: Triangles) -> GelSurface:
    """Quadratic triangles, all of whose nodes lie on the shape; a few large ones are split into more parts."""
    sides = np.sort(np.stack([triangles[:, list(edge)] for edge in FACE_EDGES], axis=1), axis=2)
    edges, number = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    nodes = np.concatenate([points, face.project(points[edges].mean(axis=1))])
    faces = np.concatenate([triangles, len(points) + number.reshape(-1, 3)], axis=1)
    used, renumbered = np.unique(faces, return_inverse=True)
    parts = max(PARTS, int(np.ceil(PARTS * REST_CELLS * (2 / len(triangles)) ** 0.5)))
    return GelSurface(ContactFaces(nodes[used], renumbered.reshape(-1, 6).astype(np.int32)), parts)
