"""Where a gel's face touches the indenter in a state, and how large that part is.

A point touches where its gap, its signed distance from the body, is closed. A mesh's face never lies on the body to the
last bit: its contact points sink in by up to the state's deepest penetration, and elsewhere it stands off by as much,
so that gaps up to this count as closed. Where a body is curved more than the elements can follow, a face also stands
off between places that touch. Such pockets, which vanish as the mesh is refined, count as closed where they are
narrower than an element (morphological closing with half an element's width, on the undeformed face).
"""

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points
from synth.press.indenter import RigidBody
from synth.press.load_path import LoadPath, Pose
from synth.press.measure import Distance
from synth.surface import ContactFaces, GelSurface

SUBDIVISIONS = 8
"""Parts of an element's edge at whose ends gaps are measured."""


SLIP_MM = 1e-3
"""A point that moved less along the body stuck: contact that sticks is elastic (docs/decisions.md)."""


class ContactPatch:
    """The part of a contact face that touches.

    Attributes:
        area_mm2: of the deformed face.
    """

    def __init__(self, face: ContactFaces, displacement: FloatArray, body: RigidBody, pose: Pose, deepest_mm: float):
        """A state by displacements (n, 3) mm of the face's nodes, the body's pose and the deepest penetration."""
        self._pose = pose
        self._distance = Distance(body, pose.centre[None], pose.rotation[None])
        self._deepest = deepest_mm if deepest_mm > 0 else -np.inf  # that of a state without contact is 0
        self._closed = self._apart = np.zeros((0, 3))
        self._reach = self.area_mm2 = 0.0
        corners = face.nodes[face.faces[:, :3]]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        gaps = self._gap(face.nodes + displacement)[face.faces].min(axis=1)
        near = gaps <= 2 * np.sqrt(2 * areas)
        if not near.any():
            return
        nodes, faces = np.unique(face.faces[near], return_inverse=True)
        part = ContactFaces(face.nodes[nodes], faces.reshape(-1, face.faces.shape[1]).astype(np.int32))
        surface = GelSurface(part, SUBDIVISIONS)
        material, deformed = surface.material, surface.positions(displacement[nodes])
        if not part.is_quadratic:  # what touches of linear elements is their facets, not the smooth surface
            deformed = material + surface.interpolate_linear(displacement[nodes])
        self._reach = float(np.sqrt(2 * areas[near].mean())) / 2
        self._closed = material[self._gap(deformed) <= self._deepest]
        self._apart = material[_away(material, self._closed) > self._reach]
        a, b, c = (deformed[corner] for corner in surface.triangles.T)
        shares = self.holds(material, deformed)[surface.triangles].mean(axis=1)
        # Not a product by BLAS, whose last bits depend on threads and on where arrays lie.
        self.area_mm2 = float((np.linalg.norm(np.cross(b - a, c - a), axis=1) * shares).sum() / 2)

    @classmethod
    def of(
        cls, face: ContactFaces, displacement: FloatArray, path: LoadPath, number: int, deepest_mm: float
    ) -> "ContactPatch":
        """That of a trajectory's state by its number, 0 for the undeformed one."""
        return cls(face, displacement, path.body, path.recorded(number), deepest_mm)

    def holds(self, material: Points, deformed: Points) -> BoolArray:
        """(n,) which material points (n, 3) mm, by their undeformed and deformed places, touch."""
        filled = (_away(material, self._closed) <= self._reach) & (_away(material, self._apart) > self._reach)
        return np.asarray(filled | (self._gap(deformed) <= self._deepest))

    def slip(self, earlier: "ContactPatch", material: Points, before: Points, now: Points) -> FloatArray:
        """Which points slipped since an earlier state: 1 where they moved along the body, 0 where not, NaN if apart.

        Points are (n, 3) mm, undeformed, in the earlier state and in this one; one that came to touch since has stuck.
        """
        moved = (now - self._pose.centre) @ self._pose.rotation
        moved -= (before - earlier._pose.centre) @ earlier._pose.rotation
        normal = self._distance(now, np.zeros(len(now), dtype=np.int32))[0] @ self._pose.rotation
        moved -= (moved * normal).sum(axis=1, keepdims=True) * normal
        slid = (np.linalg.norm(moved, axis=1) > SLIP_MM) & earlier.holds(material, before)
        return np.where(self.holds(material, now), slid, np.nan)

    def _gap(self, deformed: Points) -> FloatArray:
        return self._distance(deformed, np.zeros(len(deformed), dtype=np.int32))[1]


def _away(points: Points, others: Points) -> FloatArray:
    from scipy.spatial import KDTree

    return np.asarray(KDTree(others).query(points)[0]) if len(others) else np.full(len(points), np.inf)
