"""The gel pad's tetrahedral mesh and what the later stages ask of it."""

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points, Tets, Triangles
from synth.surface import ContactFaces

_FACES_OF_TET = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])  # normals point out of a positive tetrahedron


@dataclass(frozen=True)
class PadMesh:
    """A box of gel: contact surface at z = 0, bonded to the window at z = size[2], centred in x and y.

    Attributes:
        points: (n, 3) float64 mm.
        tets: (m, 4) int32; (b - a) x (c - a) . (d - a) > 0 by components.
        size_mm: edge lengths of the box.
    """

    points: Points
    tets: Tets
    size_mm: tuple[float, float, float]

    @cached_property
    def volumes(self) -> FloatArray:
        """(m,) float64 mm^3."""
        return signed_volumes(self.points, self.tets)

    @cached_property
    def bonded(self) -> BoolArray:
        """(n,) nodes glued to the window."""
        return self.points[:, 2] == self.size_mm[2]

    @cached_property
    def contact_nodes(self) -> np.ndarray:
        """(s,) int: nodes of the contact face in the order of `contact_faces.nodes`."""
        return np.unique(self._contact_triangles)

    @cached_property
    def contact_faces(self) -> ContactFaces:
        """The faces at z = 0, numbered within `contact_nodes`."""
        nodes = self.contact_nodes
        faces = np.searchsorted(nodes, self._contact_triangles).astype(np.int32)
        return ContactFaces(self.points[nodes], faces)

    @cached_property
    def _contact_triangles(self) -> Triangles:
        faces = boundary_faces(self.tets)
        return faces[(self.points[faces][:, :, 2] == 0).all(axis=1)]

    @cached_property
    def hash(self) -> str:
        """SHA-256 of points and tetrahedra: the mesher is not deterministic, so results name the mesh they used."""
        digest = hashlib.sha256()
        digest.update(np.ascontiguousarray(self.points, dtype="<f8").tobytes())
        digest.update(np.ascontiguousarray(self.tets, dtype="<i4").tobytes())
        return digest.hexdigest()


def signed_volumes(points: Points, tets: Tets) -> FloatArray:
    """(m,) float64 volumes, positive for positive orientation."""
    a, b, c, d = (points[tets[:, i]] for i in range(4))
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6)


def boundary_faces(tets: Tets) -> Triangles:
    """(k, 3) int32: faces of exactly one tetrahedron, normals pointing out."""
    faces = tets[:, _FACES_OF_TET].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return np.ascontiguousarray(faces[np.sort(first[count == 1])], dtype=np.int32)
