"""The undeformed face of a capsule without a mesh of its gel: for pictures of sensors at rest."""

import numpy as np

from synth.mesh import face_of, rest_surface
from synth.mesh.capsule import CapsuleFace
from synth.scene import Gel
from synth.surface import FACE_EDGES, ContactFaces, GelSurface

EDGES = 24
"""Along the diameter."""


def capsule_surface(face: CapsuleFace, edge_mm: float) -> GelSurface:
    """The coated face as quadratic triangles with edges of about that length, all of whose nodes lie on the shape."""
    points, triangles = face.triangles(edge_mm)
    triangles = triangles[face.holds(points)[triangles].all(axis=1)]
    sides = np.sort(np.stack([triangles[:, list(edge)] for edge in FACE_EDGES], axis=1), axis=2)
    edges, number = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    nodes = np.concatenate([points, face.project(points[edges].mean(axis=1))])
    faces = np.concatenate([triangles, len(points) + number.reshape(-1, 3)], axis=1)
    used, renumbered = np.unique(faces, return_inverse=True)
    return GelSurface(ContactFaces(nodes[used], renumbered.reshape(-1, 6).astype(np.int32)), 3)


def surface_at_rest(gel: Gel) -> GelSurface:
    """Of a pad or a capsule."""
    face = face_of(gel)
    return capsule_surface(face, gel.size_mm[0] / EDGES) if isinstance(face, CapsuleFace) else rest_surface(gel)
