"""Mixed tetrahedra: shape functions and quadrature of displacement, pressure and contact.

P2/P1 (Taylor-Hood): quadratic displacement, linear continuous pressure; inf-sup stable. P1/P1: both linear, which
violates the inf-sup condition; the projection of Dohrmann & Bochev (Int. J. Numer. Meth. Fluids 46, 2004) restores it:
the energy loses (alpha / 2 mu) |p - mean(p)|^2 in each element.

Nodes of a quadratic tetrahedron: its four vertices, then the midpoints of EDGES; of a quadratic face: as in
`synth.surface`.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from synth.arrays import FloatArray
from synth.surface import quadratic_face

EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))

CONTACT_SPLIT = 3
"""Parts of an edge when a face is split to integrate contact over it: with three points a face, an edge of the
indenter that is sharper than an element makes Newton's method chatter."""

P2_HOLD = 2.0
"""The second variation of D² in an unstable mode is about that of J, so that γ = |p| would balance it. P1 elements,
whose det F is constant, it would lock."""


@dataclass(frozen=True, eq=False)
class Element:
    """Tables of a tetrahedral element.

    Attributes:
        name: "p2p1", "p1p1" or "p1".
        order: polynomial degree of the displacement.
        barycentric: (nq, 4) quadrature points; also the (linear) pressure's shape functions there.
        weights: (nq,) their weights, sum 1.
        derivative: (nq, nn, 4) derivatives of the displacement's shape functions by the barycentric coordinates.
        stabilisation: alpha; 0 for an inf-sup stable pair.
        hold: C of `synth.simulate.bulk`, by which dilation is held where pressure is high.
        face_barycentric: (nf, 3) quadrature points of a face.
        face_weights: (nf,) their weights, sum 1.
        face_shape: (nf, ns) the displacement's shape functions there.
    """

    name: Literal["p2p1", "p1p1", "p1"]
    order: Literal[1, 2]
    barycentric: FloatArray
    weights: FloatArray
    derivative: FloatArray
    stabilisation: float
    hold: float
    face_barycentric: FloatArray
    face_weights: FloatArray
    face_shape: FloatArray

    @property
    def has_pressure(self) -> bool:
        return self.name != "p1"


def p2p1(contact_split: int = CONTACT_SPLIT) -> Element:
    """Taylor-Hood. Four points integrate quadratics: exact for the mass-like terms, one order short for det F."""
    a, b = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20
    points = np.full((4, 4), b) + (a - b) * np.eye(4)
    derivative = quadratic_derivative(points)
    face, weights = _face_rule(contact_split)
    return Element("p2p1", 2, points, np.full(4, 0.25), derivative, 0.0, P2_HOLD, face, weights, quadratic_face(face))


def p1p1(contact_split: int = CONTACT_SPLIT) -> Element:
    """Stabilised linear-linear element; its strain is constant, so that one point is exact."""
    centre = np.full((1, 4), 0.25)
    face, weights = _face_rule(contact_split)
    return Element("p1p1", 1, centre, np.ones(1), np.eye(4)[None], 2.0, 0.0, face, weights, face)


def quadratic_derivative(barycentric: FloatArray) -> FloatArray:
    """(n, 10, 4) derivatives of b (2 b - 1) at the vertices and of 4 b_i b_j at the midpoints, at places (n, 4)."""
    derivative = np.zeros((len(barycentric), 10, 4))
    for i in range(4):
        derivative[:, i, i] = 4 * barycentric[:, i] - 1
    for k, (i, j) in enumerate(EDGES):
        derivative[:, 4 + k, i] = 4 * barycentric[:, j]
        derivative[:, 4 + k, j] = 4 * barycentric[:, i]
    return derivative


def _face_rule(split: int) -> tuple[FloatArray, FloatArray]:
    """Points (n, 3) and weights (n,) of the three-point rule on each of a triangle's split x split parts."""
    inner = np.array([[2 / 3, 1 / 6, 1 / 6], [1 / 6, 2 / 3, 1 / 6], [1 / 6, 1 / 6, 2 / 3]])
    points = np.concatenate([inner @ corners for corners in _split_triangle(split)])
    return points, np.full(len(points), 1 / len(points))


def _split_triangle(n: int) -> list[FloatArray]:
    """Barycentric coordinates (3, 3) of the corners of the n x n equal parts of a triangle."""
    parts = []
    for i in range(n):
        for j in range(n - i):
            parts.append([(i, j), (i + 1, j), (i, j + 1)])
            if i + j < n - 1:
                parts.append([(i + 1, j + 1), (i, j + 1), (i + 1, j)])
    return [np.array([(n - i - j, i, j) for i, j in part]) / n for part in parts]
