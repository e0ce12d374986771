r"""Orientation of triangle surfaces as files have them: the boundary of all that the faces enclose.

Faces that meet in pairs at their edges form patches, each oriented alike. Patches meet where three or more faces share
an edge: where bodies touch, and at walls within a body. Which patches bound the whole, and which way each of them
faces, is the largest chain without a boundary at these edges, with c of a patch in {-1, 0, 1}:

.. math::  \max_c \sum_p c_p V_p, \quad \sum_p c_p ∂p = 0, \quad |c_p| ≤ 1

V_p is the patch's signed volume about the shell's centre. A wall between two chambers has c = 0: it is left out.
"""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from synth.arrays import FloatArray

Sides = tuple[np.ndarray, np.ndarray, np.ndarray]
MOST_SECONDS = 20.0
"""For the linear program, whose size is the number of patches that meet at edges of three or more faces."""


def is_closed(faces: np.ndarray) -> bool:
    """Whether each edge of faces (m, 3) is passed as often one way as the other, so that they enclose volumes."""
    edge, _, run = _sides(faces)
    return not np.bincount(edge, run).any()


def shells_of(faces: np.ndarray) -> np.ndarray:
    """(m,) the number, from 0, of the connected part of a surface that each of its faces (m, 3) belongs to."""
    part = _components(np.concatenate([faces[:, :2], faces[:, 1:]]), int(faces.max()) + 1)
    return np.unique(part[faces[:, 0]], return_inverse=True)[1]


def outward(points: FloatArray, faces: np.ndarray) -> np.ndarray:
    """Those of a surface's faces (m, 3), none of them twice, that bound what is enclosed, oriented outward.

    ValueError where too many faces meet at edges of three or more.
    """
    edge, face, run = sides = _sides(faces)
    patch, sign = _patches(sides, len(faces))
    shell, corners = shells_of(faces), points[faces]
    sums = [np.bincount(shell, corners[:, :, k].mean(axis=1)) for k in range(3)]
    centres = np.column_stack(sums) / np.bincount(shell)[:, None]
    volumes = np.bincount(patch, sign * np.linalg.det(corners - centres[shell][:, None]))
    chain = np.where(volumes < 0, -1.0, 1.0)
    meet = np.bincount(edge)[edge] > 2
    places = np.unique(edge[meet], return_inverse=True)[1], patch[face[meet]]
    boundary = sp.csr_matrix(((run * sign[face])[meet], places), shape=(meet.sum(), len(volumes)))
    among = np.unique(boundary.nonzero()[1])
    if len(among):
        from scipy.optimize import linprog  # takes a third of a second

        balance, none = boundary[:, among], np.zeros(boundary.shape[0])
        found = linprog(-volumes[among], None, None, balance, none, (-1, 1), options={"time_limit": MOST_SECONDS}).x
        if found is None:
            raise ValueError("too many faces meet at edges of three or more; join its parts to one")
        chain[among] = found
    sign = sign * np.round(chain)[patch]
    return np.where(sign[:, None] < 0, faces[:, ::-1], faces)[sign != 0]


def _sides(faces: np.ndarray) -> Sides:
    """Of the 3 m sides of faces (m, 3): the number of the edge, the face, and 1 or -1 by which way they run."""
    start, end = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
    numbers = np.minimum(start, end) * (faces.max() + 1) + np.maximum(start, end)
    return np.unique(numbers, return_inverse=True)[1], np.tile(np.arange(len(faces)), 3), np.where(start < end, 1, -1)


def _patches(sides: Sides, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The number of each face's patch, and 1 or, where it is oriented against the patch's first face, -1."""
    edge, face, run = sides
    order, size = np.argsort(edge, kind="stable"), np.bincount(edge)
    first = (np.cumsum(size) - size)[size == 2]
    one, other = order[first], order[first + 1]
    # Each face stands as filed, by its number, and turned, by its number + count.
    turn = np.where(run[one] == run[other], count, 0)
    links = [np.column_stack([face[one] + k, face[other] + (turn + k) % (2 * count)]) for k in (0, count)]
    part = _components(np.concatenate(links), 2 * count)
    patch = np.unique(np.minimum(part[:count], part[count:]), return_inverse=True)[1]
    return patch, np.where(part[:count] <= part[count:], 1, -1)


def _components(links: np.ndarray, count: int) -> np.ndarray:
    graph = sp.csr_matrix((np.ones(len(links), dtype=bool), tuple(links.T)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])
