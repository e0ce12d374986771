"""The gel pad's tetrahedral mesh and what the later stages ask of it."""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Points, Tets, Triangles
from synth.errors import InputError
from synth.mesh.face import FLAT_FACE, Face

_FACES_OF_TET = np.array([(1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1)])  # normals point out of a positive tetrahedron

FLAT = 1e-10
"""Volume over the longest edge cubed of a tetrahedron that counts as flat: rounding leaves up to some 1e-17."""


@dataclass(frozen=True)
class PadMesh:
    """A gel, centred in x and y: a contact face that touches z = 0 at its lowest point, and a face on the window.

    Attributes:
        points: (n, 3) float64 mm.
        tets: (m, 4) int32; (b - a) x (c - a) . (d - a) > 0 by components.
        size_mm: edge lengths of the gel's bounding box.
        layer: (m,) int32, the layer of material that each tetrahedron lies in, counted from the contact face; left
            out, all lie in layer 0.
        face: the shape of the contact face.
    """

    points: Points
    tets: Tets
    size_mm: tuple[float, float, float]
    layer: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, dtype=np.int32))
    face: Face = FLAT_FACE

    def __post_init__(self) -> None:
        if self.layer.size == 0:
            object.__setattr__(self, "layer", np.zeros(len(self.tets), dtype=np.int32))

    @cached_property
    def volumes(self) -> FloatArray:
        """(m,) float64 mm^3."""
        return signed_volumes(self.points, self.tets)

    @cached_property
    def bonded(self) -> BoolArray:
        """(n,) nodes glued to the window."""
        return self.face.bonded(self.points, self.size_mm)

    @cached_property
    def on_face(self) -> BoolArray:
        """(n,) nodes of the contact face."""
        return self.face.holds(self.points)

    @cached_property
    def touchable(self) -> Triangles:
        """(k, 3) int32 into `points`: boundary faces that are not bonded, normals pointing out."""
        faces = self._boundary
        return faces[~self.bonded[faces].all(axis=1)]

    @cached_property
    def coated(self) -> Triangles:
        """(k, 3) int32 into `points`: the contact face's triangles, normals pointing out."""
        return self._boundary[self.on_face[self._boundary].all(axis=1)]

    @cached_property
    def spacing_mm(self) -> float:
        """Length of the contact face's short edges, their 10 % quantile: what the finest part resolves."""
        edges = self.points[self.coated] - self.points[np.roll(self.coated, 1, axis=1)]
        return float(np.quantile(np.linalg.norm(edges, axis=2), 0.1))

    @cached_property
    def _boundary(self) -> Triangles:
        return boundary_faces(self.tets)

    @cached_property
    def hash(self) -> str:
        """SHA-256 of points, tetrahedra and, where there are several, their layers.

        fTetWild is not deterministic, so results name the mesh they used.
        """
        digest = hashlib.sha256()
        digest.update(np.ascontiguousarray(self.points, dtype="<f8").tobytes())
        digest.update(np.ascontiguousarray(self.tets, dtype="<i4").tobytes())
        if self.layer.any():
            digest.update(np.ascontiguousarray(self.layer, dtype="<i4").tobytes())
        return digest.hexdigest()


def check_mesh(mesh: PadMesh) -> None:
    """Refuse, by InputError, points that are not finite, elements without volume or inside out, nodes of no element."""
    if not np.isfinite(mesh.points).all():
        raise InputError("the mesh has points that are not finite")
    corners = mesh.points[mesh.tets]
    longest = np.linalg.norm(corners[:, :, None] - corners[:, None], axis=-1).max(axis=(1, 2))
    share = mesh.volumes / np.maximum(longest, np.finfo(float).tiny ** 0.25) ** 3
    if share.min() <= FLAT:
        number = int(share.argmin())
        raise InputError(
            f"tetrahedron {number} of the mesh has a volume of {mesh.volumes[number]:.3g} mm^3; it must be > 0, and "
            f"more than {FLAT:g} of its longest edge cubed"
        )
    loose = np.setdiff1d(np.arange(len(mesh.points)), mesh.tets)
    if len(loose):
        raise InputError(f"node {loose[0]} of the mesh belongs to no tetrahedron ({len(loose)} such nodes)")


def signed_volumes(points: Points, tets: Tets) -> FloatArray:
    """(m,) float64 volumes, positive for positive orientation."""
    a, b, c, d = (points[tets[:, i]] for i in range(4))
    return np.asarray(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6)


def barycentric_gradients(points: Points, tets: Tets) -> FloatArray:
    """(m, 4, 3) float64 1/mm: gradients of the four barycentric coordinates in the undeformed tetrahedra."""
    corner = points[tets]
    inverse = np.linalg.inv(corner[:, 1:] - corner[:, :1])  # columns are the gradients of coordinates 1..3
    gradients = np.swapaxes(inverse, 1, 2)
    return np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)


def boundary_faces(tets: Tets) -> Triangles:
    """(k, 3) int32: faces of exactly one tetrahedron, normals pointing out."""
    faces = tets[:, _FACES_OF_TET].reshape(-1, 3)
    nodes = int(tets.max()) + 1  # below 2e6, so that a face's nodes fit one 64-bit number
    name = np.sort(faces, axis=1).astype(np.int64) @ np.array([nodes * nodes, nodes, 1])
    _, first, count = np.unique(name, return_index=True, return_counts=True)
    return np.ascontiguousarray(faces[np.sort(first[count == 1])], dtype=np.int32)
