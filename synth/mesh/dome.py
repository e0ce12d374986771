r"""Pads whose contact face is part of a sphere: the meshes of boxes, mapped; and the undeformed face by itself.

The face z_f(x, y) = R - sqrt(R² - x² - y²) touches z = 0 at its apex; the pad's sides and its bonded face, z = H, stay
as they are. A point of the box goes to

.. math::  z' = z_f + z \frac{H - z_f}{H}

so that layers, and the elements' heights, keep their shares of the thickness. Structured meshes stay valid whatever R:
each of their tetrahedra has one edge along z, and its volume is a third of the area of its shadow on z = 0 times that
edge's length, which the map shortens by (H - z_f) / H and nothing else. They are flattened and sheared toward the
corners. Unstructured tetrahedra may turn over, which is checked.

The mesh is the chords' polyhedron: its volume differs from the cap's by O(h²). `synth.simulate.space` puts the
mid-edge nodes of the face back on the sphere, for contact and for the picture.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from synth.errors import InputError
from synth.mesh.capsule import CapsuleFace
from synth.mesh.face import PadFace, face_height, face_of
from synth.mesh.pad import PadMesh
from synth.scene import Gel
from synth.surface import FACE_EDGES, ContactFaces, GelSurface

REST_CELLS = 24
"""Squares of the undeformed face along its longer side."""


def domed(mesh: PadMesh, dome_radius_mm: float | None) -> PadMesh:
    """A flat pad's mesh with its contact face bulged to a sphere; the mesh itself for None.

    InputError where a tetrahedron turns over.
    """
    if dome_radius_mm is None:
        return mesh
    points, thickness = mesh.points.copy(), mesh.size_mm[2]
    face = face_height(points[:, :2], dome_radius_mm)
    inner = face + points[:, 2] * ((thickness - face) / thickness)
    # The face's nodes and the bonded ones come out to the last bit.
    points[:, 2] = np.where(points[:, 2] == thickness, thickness, inner)
    bulged = replace(mesh, points=points, face=PadFace(dome_radius_mm))
    if bulged.volumes.min() <= 0:
        raise InputError(
            f"a mesh of even edge length turns over where it is bulged to sensor.gel.dome_radius_mm = "
            f"{dome_radius_mm}: leave out numerics.edge_length_mm, or make it smaller"
        )
    return bulged


def rest_surface(gel: Gel, folder: Path = Path()) -> GelSurface:
    """The undeformed contact face, of a dome in quadratic triangles; a gel's files are relative to `folder`.

    Light that varies smoothly is linear on each triangle. The surface does not depend on the meshes of trajectories, so
    that neither does the picture of a sensor at rest.
    """
    face = face_of(gel, folder)
    if not isinstance(face, PadFace):
        if isinstance(face, CapsuleFace):
            points, triangles = face.triangles(gel.size_mm[0] / (2 * REST_CELLS))
            triangles = triangles[face.holds(points)[triangles].all(axis=1)]
        else:
            points, triangles = np.asarray(face.surfaces.face.points, float), face.surfaces.face.regular_faces
        parts = int(np.ceil(2 * REST_CELLS / len(triangles) ** 0.5))  # of a file's triangles, which may be few
        return GelSurface(ContactFaces(points, triangles), parts)
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
    return GelSurface(ContactFaces(nodes[used], renumbered.reshape(-1, 6).astype(np.int32)), 3)
