r"""The gel's inner surface as it is rendered and traced: the FEM's contact faces, subdivided and smoothed.

Linear elements leave a faceted surface whose edges would show in the shading and as kinks in the flow. Each contact
face is split into n x n triangles, and displacement is carried to their corners by blending the first-order expansions
at the face's three nodes (barycentric coordinates λ, recovered nodal gradients G):

.. math::  u(x) = \sum_i λ_i(x) [ u_i + ½ G_i (x - x_i) ]

which interpolates the nodes, is continuous across faces, and reproduces quadratic fields where the recovered gradients
are exact (Zienkiewicz & Zhu 1992 for the recovery; area-weighted mean of the adjoining faces' gradients here). It is a
fixed linear map of the nodal displacements, kept as one sparse matrix. The surface defined here *is* the geometry for
which images and flow are exact; its distance from the continuum's is part of the simulation's discretisation error.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Points, Triangles


@dataclass(frozen=True)
class ContactFaces:
    """The part of a pad's boundary that carries the coating.

    Attributes:
        nodes: (n, 3) float64 mm, undeformed positions.
        faces: (k, 3) int32 into `nodes`; their normals (right-hand rule on the components) point out of the gel.
    """

    nodes: Points
    faces: Triangles


@dataclass(frozen=True)
class GelSurface:
    """Refined contact surface.

    Attributes:
        coarse: the FEM's faces.
        subdivisions: each coarse edge becomes so many.
    """

    coarse: ContactFaces
    subdivisions: int = 4

    @cached_property
    def _refined(self) -> tuple[Points, Triangles, FloatArray, Triangles]:
        return _subdivide(self.coarse, self.subdivisions)

    @property
    def material(self) -> Points:
        """(v, 3) float64 mm: undeformed positions of the refined vertices."""
        return self._refined[0]

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
        _, _, weights, corners = self._refined
        return np.einsum("vi,vic->vc", weights, nodal[corners])

    @cached_property
    def _smooth(self) -> Any:
        import scipy.sparse as sp

        material, _, weights, corners = self._refined
        nodes, n, v = self.coarse.nodes, len(self.coarse.nodes), len(material)
        rows = np.repeat(np.arange(v), 3)
        linear = sp.csr_matrix((weights.ravel(), (rows, corners.ravel())), shape=(v, n))
        correction = sp.csr_matrix((v, n))
        offset = material[:, None, :] - nodes[corners]
        for axis, gradient in enumerate(_recovered_gradients(self.coarse)):
            arm = sp.csr_matrix(((0.5 * weights * offset[:, :, axis]).ravel(), (rows, corners.ravel())), shape=(v, n))
            correction = correction + arm @ gradient
        return (linear + correction).tocsr()


def _subdivide(coarse: ContactFaces, n: int) -> tuple[Points, Triangles, FloatArray, Triangles]:
    """Split each face into n x n triangles; returns vertices, triangles, and each vertex's weights and coarse nodes."""
    nodes, faces = coarse.nodes, coarse.faces.astype(np.int64)
    grid = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)])
    local = np.column_stack([n - grid.sum(1), grid])  # integer barycentric coordinates, sum n
    number = {(int(i), int(j)): k for k, (i, j) in enumerate(grid)}
    small = []
    for i in range(n):
        for j in range(n - i):
            small.append((number[i, j], number[i + 1, j], number[i, j + 1]))
            if i + j < n - 1:
                small.append((number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]))
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
    return material, triangles, weights, corners


def _recovered_gradients(coarse: ContactFaces) -> list[Any]:
    """Three sparse (n, n) matrices: nodal values -> x, y, z of the recovered surface gradient at the nodes."""
    import scipy.sparse as sp

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
