r"""The gel's inner surface as it is rendered and traced: the FEM's contact faces, subdivided.

Each contact face is split into n x n triangles. Faces of quadratic elements (three vertices, then the midpoints of
FACE_EDGES) carry displacement to the corners of these by their own shape functions. Linear elements would leave a
faceted surface whose edges show in the shading and as kinks in the flow; there the first-order expansions at the
face's three nodes are blended (barycentric coordinates λ, recovered nodal gradients G):

.. math::  u(x) = \sum_i λ_i(x) [ u_i + ½ G_i (x - x_i) ]

which interpolates the nodes, is continuous across faces, and reproduces quadratic fields where the recovered gradients
are exact (Zienkiewicz & Zhu 1992 for the recovery; area-weighted mean of the adjoining faces' gradients here). It is a
fixed linear map of the nodal displacements, kept as one sparse matrix. The surface defined here *is* the geometry for
which images and flow are exact; its distance from the continuum's is part of the simulation's discretisation error.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from synth.arrays import FloatArray, Points, Triangles

FACE_EDGES = ((0, 1), (1, 2), (2, 0))
"""The edges whose midpoints are nodes 3, 4, 5 of a quadratic face."""


def quadratic_face(barycentric: FloatArray) -> FloatArray:
    """(n, 6) quadratic shape functions of a triangle at barycentric coordinates (n, 3)."""
    corners = barycentric * (2 * barycentric - 1)
    edges = [4 * barycentric[:, i] * barycentric[:, j] for i, j in FACE_EDGES]
    return np.column_stack([corners, *edges])


def broken_linear_face(barycentric: FloatArray) -> FloatArray:
    """(n, 6) the same nodes' piecewise linear functions on the four triangles between them: never negative."""
    edges = []
    for i, j in FACE_EDGES:
        near_i, near_j = barycentric[:, i] > 0.5, barycentric[:, j] > 0.5
        inner = np.where(barycentric.max(axis=1) > 0.5, 0.0, 1 - 2 * barycentric[:, 3 - i - j])
        edges.append(np.where(near_i, 2 * barycentric[:, j], np.where(near_j, 2 * barycentric[:, i], inner)))
    return np.column_stack([np.maximum(2 * barycentric - 1, 0), *edges])


@dataclass(frozen=True)
class ContactFaces:
    """The part of a pad's boundary that carries the coating, by undeformed nodes (n, 3) float64 mm.

    Faces are (k, 3) or, quadratic, (k, 6) int32; the normals of their vertices (right-hand rule on the components)
    point out of the gel.
    """

    nodes: Points
    faces: Triangles

    @property
    def is_quadratic(self) -> bool:
        """Whether the faces have nodes on their edges."""
        return self.faces.shape[1] == 6


@dataclass(frozen=True)
class GelSurface:
    """Refined contact surface: each edge of the FEM's faces, `coarse`, is split into `subdivisions` edges."""

    coarse: ContactFaces
    subdivisions: int

    @cached_property
    def _refined(self) -> tuple[Points, Triangles, FloatArray, Triangles, np.ndarray]:
        return _subdivide(self.coarse, self.subdivisions)

    @cached_property
    def material(self) -> Points:
        """(v, 3) float64 mm: undeformed positions of the refined vertices.

        Faces whose mid-edge nodes lie beside their edges' middles, as on a dome, are curved: they follow their own
        shape functions.
        """
        straight = self._refined[0]
        if not self.coarse.is_quadratic:
            return straight
        nodes, faces = self.coarse.nodes, self.coarse.faces
        bulge = np.zeros_like(nodes)  # from the middles of the coarse faces' edges to their nodes
        for k, (i, j) in enumerate(FACE_EDGES, 3):
            bulge[faces[:, k]] = nodes[faces[:, k]] - (nodes[faces[:, i]] + nodes[faces[:, j]]) / 2
        return np.asarray(straight + self._matrix(quadratic_face) @ bulge) if bulge.any() else straight

    @property
    def triangles(self) -> Triangles:
        """(f, 3) int32: refined triangles, oriented as the coarse ones."""
        return self._refined[1]

    def positions(self, displacement: FloatArray) -> Points:
        """Deformed positions (v, 3) mm for nodal displacements (n, 3) mm of the coarse nodes."""
        return self.material + self.interpolate(displacement)

    def interpolate(self, nodal: FloatArray) -> FloatArray:
        """Smooth interpolation (v, c) of nodal values (n, c)."""
        return np.asarray(self._smooth @ nodal)

    def interpolate_linear(self, nodal: FloatArray) -> FloatArray:
        """Piecewise linear interpolation (v, c) of nodal values (n, c), for fields that jump (traction)."""
        return np.asarray(self._linear @ nodal)

    @cached_property
    def _linear(self) -> Any:
        if self.coarse.is_quadratic:
            return self._matrix(broken_linear_face)
        _, _, weights, corners, _ = self._refined
        rows, shape = np.repeat(np.arange(len(weights)), 3), (len(weights), len(self.coarse.nodes))
        return sp.csr_matrix((weights.ravel(), (rows, corners.ravel())), shape=shape)

    @cached_property
    def _smooth(self) -> Any:
        if self.coarse.is_quadratic:
            return self._matrix(quadratic_face)
        material, _, weights, corners, _ = self._refined
        nodes, n, v = self.coarse.nodes, len(self.coarse.nodes), len(material)
        rows = np.repeat(np.arange(v), 3)
        correction = sp.csr_matrix((v, n))
        offset = material[:, None, :] - nodes[corners]
        for axis, gradient in enumerate(_recovered_gradients(self.coarse)):
            arm = sp.csr_matrix(((0.5 * weights * offset[:, :, axis]).ravel(), (rows, corners.ravel())), shape=(v, n))
            correction = correction + arm @ gradient
        return (self._linear + correction).tocsr()

    def _matrix(self, shape: Callable[[FloatArray], FloatArray]) -> Any:
        """Sparse (v, n) map of nodal values by a quadratic face's shape functions at the refined vertices."""
        faces, local, vertex = self.coarse.faces, _grid(self.subdivisions)[1], self._refined[4]
        values = shape(local / self.subdivisions)
        # A vertex on an edge belongs to two faces, which agree there: the last one is taken.
        vertices = len(self._refined[0])
        face, place = np.zeros(vertices, dtype=int), np.zeros(vertices, dtype=int)
        face[vertex], place[vertex] = np.indices(vertex.shape)
        rows = np.repeat(np.arange(len(face)), 6)
        size = (len(face), len(self.coarse.nodes))
        return sp.csr_matrix((values[place].ravel(), (rows, faces[face].ravel())), shape=size)


def _grid(n: int) -> tuple[list[tuple[int, int, int]], np.ndarray]:
    """The n x n parts of a triangle as vertices, and the vertices' integer barycentric coordinates, sum n."""
    grid = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)])
    local = np.column_stack([n - grid.sum(1), grid])
    number = {(int(i), int(j)): k for k, (i, j) in enumerate(grid)}
    small = []
    for i in range(n):
        for j in range(n - i):
            small.append((number[i, j], number[i + 1, j], number[i, j + 1]))
            if i + j < n - 1:
                small.append((number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]))
    return small, local


def _subdivide(coarse: ContactFaces, n: int) -> tuple[Points, Triangles, FloatArray, Triangles, np.ndarray]:
    """Split each face into n x n triangles.

    Vertices; triangles; each vertex's weights and the coarse corners they belong to; and each coarse face's vertices,
    in the order of `_grid`.
    """
    nodes, faces = coarse.nodes, coarse.faces[:, :3].astype(np.int64)
    small, local = _grid(n)
    # A vertex is its (coarse node, integer weight) pairs, those of weight 0 left out: shared edges merge exactly.
    weight = np.broadcast_to(local, (len(faces), *local.shape))
    corner = np.where(weight > 0, faces[:, None, :], -1)
    order = np.argsort(corner, axis=2, kind="stable")
    label = np.stack([np.take_along_axis(a, order, axis=2) for a in (corner, weight)], axis=-1).reshape(-1, 6)
    unique, inverse = np.unique(label, axis=0, return_inverse=True)
    inverse = inverse.reshape(len(faces), len(local))
    triangles = inverse[:, np.array(small)].reshape(-1, 3).astype(np.int32)
    weights = unique[:, 1::2] / n
    corners = np.maximum(unique[:, 0::2], 0).astype(np.int32)  # any node will do where the weight is 0
    material = np.einsum("vi,vic->vc", weights, nodes[corners])
    return material, triangles, weights, corners, inverse


def _recovered_gradients(coarse: ContactFaces) -> list[Any]:
    """Three sparse (n, n) matrices: nodal values -> x, y, z of the recovered surface gradient at the nodes."""
    nodes, faces = coarse.nodes, coarse.faces
    n, k = len(nodes), len(faces)
    a, b, c = (nodes[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    double_area = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = normal / double_area
    hat = np.stack([np.cross(unit, edge) for edge in (c - b, a - c, b - a)], axis=1) / double_area[:, :, None]
    to_node = sp.csr_matrix((np.repeat(double_area, 3), (faces.ravel(), np.repeat(np.arange(k), 3))), shape=(n, k))
    to_node = sp.diags(1 / np.asarray(to_node.sum(1)).ravel()) @ to_node
    rows = np.repeat(np.arange(k), 3)
    return [
        to_node @ sp.csr_matrix((hat[:, :, axis].ravel(), (rows, faces.ravel())), shape=(k, n)) for axis in range(3)
    ]


def vertex_normals(positions: Points, triangles: Triangles) -> Points:
    """Unit normals (v, 3) at vertices: the mean of the adjoining triangles' normals, weighted by area, as rendered.

    Positions are (v, 3) float64 mm; a vertex of none of the triangles (f, 3) gets zeros. Normals lie on the side to
    which triangles are oriented (right-hand rule on the components).
    """
    a, b, c = (positions[corner] for corner in triangles.T)
    weighted = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    total = np.column_stack([np.bincount(triangles.ravel(), w, len(positions)) for w in weighted.T])
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
