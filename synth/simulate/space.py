"""The finite-element space of a pad: which nodes carry displacement and pressure, which are held, what can touch.

Displacement is continuous everywhere; pressure is continuous within a layer of the pad and jumps at the interface of
two, as it does in nature.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from synth.arrays import BoolArray, Points, Tets
from synth.mesh import PadMesh
from synth.mesh.element import EDGES, Element
from synth.surface import FACE_EDGES, ContactFaces


@dataclass(frozen=True, eq=False)
class Space:
    mesh: PadMesh  # the pad's linear tetrahedra
    element: Element  # on each of them
    points: Points  # (n, 3) float64 mm, displacement nodes: the mesh's vertices, then the edges' midpoints for P2
    nodes: np.ndarray  # (m, nn) int32 displacement nodes of each element
    pressure_nodes: Tets  # (m, 4) int32 pressure unknowns of each element
    pressures: int  # number of pressure unknowns
    held: BoolArray  # (n, 3) bool, displacement components that keep their value
    faces: np.ndarray  # (f, ns) int32 displacement nodes of the boundary faces that can touch

    @cached_property
    def surface_nodes(self) -> np.ndarray:
        """(s,) int: displacement nodes of the coated contact face, in the order of `surface.nodes`."""
        return np.unique(self._coated)

    @cached_property
    def surface(self) -> ContactFaces:
        nodes = self.surface_nodes
        return ContactFaces(self.points[nodes], np.searchsorted(nodes, self._coated).astype(np.int32))

    @cached_property
    def _coated(self) -> np.ndarray:
        return self.faces[self.coated]

    @cached_property
    def coated(self) -> BoolArray:
        """(f,) which of the faces make up the contact face; the others are the pad's sides."""
        return np.asarray(self.mesh.on_face[self.faces[:, :3]].all(axis=1))


def function_space(mesh: PadMesh, element: Element) -> Space:
    """The space of an element on a mesh, held where the pad is bonded to the window."""
    touchable = mesh.touchable
    vertices = len(mesh.points)
    points, nodes, faces = mesh.points, mesh.tets, touchable
    bonded = mesh.bonded
    if element.order == 2:
        edges, number = _edges(mesh.tets)
        points = np.concatenate([mesh.points, _middles(mesh, edges)])
        nodes = np.concatenate([mesh.tets, vertices + number], axis=1)
        key = edges[:, 0].astype(np.int64) * vertices + edges[:, 1]
        middle = []
        for i, j in FACE_EDGES:
            ends = np.sort(touchable[:, [i, j]], axis=1).astype(np.int64)
            middle.append(vertices + np.searchsorted(key, ends[:, 0] * vertices + ends[:, 1]))
        faces = np.column_stack([touchable, *middle])
        bonded = np.concatenate([bonded, bonded[edges].all(axis=1)])
    layered = mesh.layer[:, None].astype(np.int64) * vertices + mesh.tets
    unique, pressure_nodes = np.unique(layered, return_inverse=True)
    return Space(
        mesh=mesh,
        element=element,
        points=points,
        nodes=np.ascontiguousarray(nodes, dtype=np.int32),
        pressure_nodes=pressure_nodes.reshape(mesh.tets.shape).astype(np.int32),
        pressures=len(unique),
        held=np.repeat(bonded[:, None], 3, axis=1),
        faces=np.ascontiguousarray(faces, dtype=np.int32),
    )


def _middles(mesh: PadMesh, edges: np.ndarray) -> Points:
    """(e, 3) mid-edge nodes: half way, but those of the contact face on its shape.

    What touches, and what is rendered, is then smooth. The bulk is integrated over straight-sided elements, which makes
    an error of the order of h²/R, as their chords do.
    """
    middles = np.asarray(mesh.points[edges].mean(axis=1))
    on_face = mesh.on_face[edges].all(axis=1)
    middles[on_face] = mesh.face.project(middles[on_face])
    return middles


def _edges(tets: Tets) -> tuple[np.ndarray, np.ndarray]:
    """(e, 2) vertices of the mesh's edges, sorted, and (m, 6) the number of each element's edges."""
    pairs = np.sort(np.stack([tets[:, list(edge)] for edge in EDGES], axis=1), axis=2)
    edges, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    return edges, number.reshape(len(tets), len(EDGES))
