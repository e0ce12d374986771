"""The mixed tetrahedron: shape functions, quadrature and pressure stabilisation of the P1/P1 element.

Linear displacement and linear continuous pressure violate the inf-sup condition; the projection of Dohrmann & Bochev
(Int. J. Numer. Meth. Fluids 46, 2004) restores it: the energy loses (alpha / 2 mu) |p - mean(p)|^2 in each element.
The deformation gradient and so the integrands of the momentum balance are constant in the element (pressure enters only
through its mean), so one quadrature point is exact.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Points, Tets


@dataclass(frozen=True)
class Element:
    """Tables of a tetrahedral element.

    Attributes:
        barycentric: (nq, 4) quadrature points.
        weights: (nq,) their weights, sum 1.
        shape: (nq, nn) displacement shape functions at the quadrature points.
        derivative: (nq, nn, 4) their derivatives with respect to the barycentric coordinates.
        stabilisation: alpha; 0 for an inf-sup stable pair.
        face_barycentric, face_weights, face_shape: the same on a face, (nf, 3), (nf,), (nf, ns), for contact.
    """

    barycentric: FloatArray
    weights: FloatArray
    shape: FloatArray
    derivative: FloatArray
    stabilisation: float
    face_barycentric: FloatArray
    face_weights: FloatArray
    face_shape: FloatArray


CONTACT_SPLIT = 3
"""Contact is integrated over each face split into so many parts an edge: with three points a face, an edge of the
indenter that is sharper than an element made Newton's method chatter (2 of 6 trial presses completed, 6 of 6 with 27
points)."""


def p1p1(stabilisation: float = 2.0) -> Element:
    """Stabilised linear-linear element."""
    centre = np.full((1, 4), 0.25)
    inner = np.array([[2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]])
    points = np.concatenate([inner @ corners for corners in _split_triangle(CONTACT_SPLIT)])
    return Element(
        barycentric=centre,
        weights=np.ones(1),
        shape=centre.copy(),
        derivative=np.eye(4)[None],
        stabilisation=stabilisation,
        face_barycentric=points,
        face_weights=np.full(len(points), 1 / len(points)),
        face_shape=points,
    )


def _split_triangle(n: int) -> list[FloatArray]:
    """Barycentric coordinates (3, 3) of the corners of the n x n equal parts of a triangle."""
    parts = []
    for i in range(n):
        for j in range(n - i):
            parts.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < n - 1:
                parts.append([(i + 1, j + 1), (i, j + 1), (i + 1, j)])
    return [np.array([(n - i - j, i, j) for i, j in part]) / n for part in parts]


def barycentric_gradients(points: Points, tets: Tets) -> FloatArray:
    """(m, 4, 3) float64 1/mm: gradients of the four barycentric coordinates in the undeformed tetrahedra."""
    corner = points[tets]
    edges = corner[:, 1:] - corner[:, :1]
    inverse = np.linalg.inv(edges)  # columns are the gradients of coordinates 1..3
    gradients = np.swapaxes(inverse, 1, 2)
    return np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)
