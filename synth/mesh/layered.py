r"""Layers by depth in fTetWild's meshes: the gel makes room below its contact face, and prisms fill it.

A mesh of one material is deformed by a harmonic displacement: with c the thickness of all layers and n the outward
normal,

.. math::  Δu = 0, \qquad u = -c\,n \text{ on the contact face}, \qquad u = 0 \text{ on the window},

sliding along the other sides. A flat gel is compressed evenly, so that its tetrahedra keep their shares of the depth.
Between each triangle of the face and the place to which it has moved stand prisms, some for every layer, of three
tetrahedra each. Layers may thus be as thin as coatings are, and the interfaces follow the face's own triangles.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points, Projection, Tets, Triangles
from synth.errors import InputError
from synth.mesh.graded import FILM
from synth.mesh.pad import PadMesh, barycentric_gradients

ON_SIDE_MM = 1e-6
"""Distance from a side at which a vertex lies on it."""


def elements_through(layers_mm: Sequence[float], edge_mm: float) -> list[int]:
    """Elements through each layer of a mesh with such edges on its contact face, about as high as these are long."""
    return [max(FILM, round(thickness / edge_mm)) for thickness in layers_mm]


def layered(mesh: PadMesh, sides: Sequence[Projection], layers_mm: Sequence[float]) -> PadMesh:
    """A gel's mesh with layers of these thicknesses, from the contact face inward; the mesh itself for none.

    `sides` are projections onto the parts of the gel's boundary, the window and then the contact face last. InputError
    where the layers leave no room for elements.
    """
    if not layers_mm:
        return mesh
    thickness, elements = sum(layers_mm), elements_through(layers_mm, mesh.spacing_mm)
    nodes, coated = np.unique(mesh.coated, return_inverse=True)
    moved = mesh.points + _room(mesh, sides[-2], thickness)
    for side in sides[:-2]:
        on = _lies_on(side, mesh.points)
        moved[on] = side(moved[on])
    layer = np.repeat(np.arange(len(layers_mm)), elements)
    depth = np.cumsum([0.0, *np.divide(layers_mm, elements)[layer]])[:-1, None, None]
    planes = mesh.points[nodes] + depth / thickness * (moved[nodes] - mesh.points[nodes])
    numbers = np.vstack([len(moved) + np.arange(len(layer) * len(nodes)).reshape(len(layer), -1), nodes])
    faces = coated.reshape(-1, 3).astype(np.int32)
    prisms = [_prisms(faces, *pair) for pair in pairwise(numbers)]
    found = PadMesh(
        np.concatenate([moved, planes.reshape(-1, 3)]),
        np.concatenate([mesh.tets, *prisms]).astype(np.int32),
        mesh.size_mm,
        np.repeat([len(layers_mm), *layer], [len(mesh.tets), *map(len, prisms)]).astype(np.int32),
        mesh.face,
    )
    if found.volumes.min() <= 0:
        raise InputError(
            f"sensor.gel.layers: {thickness:.3g} mm of layers leave no room for elements below them where the gel is "
            "thinnest or most curved; make them thinner, or try another numerics.edge_length_mm"
        )
    return found


def _lies_on(side: Projection, points: Points) -> BoolArray:
    return np.asarray(np.abs(points - side(points)).max(axis=1) < ON_SIDE_MM)


def _room(mesh: PadMesh, window: Projection, thickness: float) -> FloatArray:
    """(n, 3) mm: the displacement u of the module's docstring, before it slides."""
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import splu

    normals = np.zeros_like(mesh.points)
    a, b, c = np.swapaxes(mesh.points[mesh.coated], 0, 1)
    np.add.at(normals, mesh.coated, np.cross(b - a, c - a)[:, None])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    moved = -thickness * normals / np.where(length > 0, length, 1.0)
    free = (length[:, 0] == 0) & ~_lies_on(window, mesh.points)
    slopes = barycentric_gradients(mesh.points, mesh.tets)
    values = mesh.volumes[:, None, None] * (slopes @ np.swapaxes(slopes, 1, 2))
    places = np.repeat(mesh.tets, 4, axis=1).ravel(), np.tile(mesh.tets, 4).ravel()
    matrix = coo_array((values.ravel(), places)).tocsr()[free]
    moved[free] = splu(matrix[:, free].tocsc()).solve(-(matrix @ moved))
    return moved


def _prisms(faces: Triangles, outer: np.ndarray, inner: np.ndarray) -> Tets:
    """(3 f, 4) tetrahedra between faces (f, 3), normals outward, whose nodes have numbers (k,) on two planes.

    Each side of a prism is cut from its first node's outer place to its last one's inner place: neighbours agree.
    """
    a, b, c = np.sort(faces, axis=1).T
    quads = (outer[a], outer[c], outer[b], inner[c]), (outer[a], outer[b], inner[b], inner[c])
    tets = np.stack([*quads, (outer[a], inner[b], inner[a], inner[c])]).swapaxes(1, 2)
    turned = ~np.logical_xor.reduce([faces[:, i] < faces[:, j] for i, j in ((0, 1), (1, 2), (0, 2))])
    tets[:, turned] = tets[:, turned][..., [0, 2, 1, 3]]
    return np.asarray(tets.reshape(-1, 4))
