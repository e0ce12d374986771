r"""Light that a round gel sends to itself across its cavity, without the noise of the paths that sampled it.

A point x of the face with the normal n gets, from directions ω in which it sees the radiance L,

.. math::  E = \int L(ω) \max(n · ω, 0) \, dω = n · V(x), \qquad V(x) = \int L(ω) \, ω \, dω ,

where all of the gel lies above the point's horizon: exactly so in a convex cavity, nearly so where a contact bulges
into it. V is smooth, and is fitted to the means of all faces as polynomials of the place.
"""

from itertools import product

import numpy as np

from synth.arrays import FloatArray, Image, Points

_DEGREE = 4
"""Of V's polynomials."""


def across_cavity(means: FloatArray, positions: Points, normals: Points, faces: np.ndarray) -> Image:
    """Irradiance at the corners of faces, (f, channels, 3) float32.

    Args:
        means: (f, channels) irradiance sampled on each face.
        positions: (v, 3) of the vertices.
        normals: (v, 3) unit, all on the same side of the face.
        faces: (f, 3) vertices.
    """
    low, high = positions.min(axis=0), positions.max(axis=0)
    places = 2 * (positions - low) / (high - low) - 1
    centre, upright = places[faces].mean(axis=1), normals[faces].mean(axis=1)
    design = _terms(centre, upright)
    found = np.linalg.lstsq(design.T @ design, design.T @ means, rcond=None)[0]
    at_vertices = np.maximum(_terms(places, normals) @ found, 0)
    return np.ascontiguousarray(at_vertices[faces].swapaxes(1, 2), dtype=np.float32)


def _terms(places: Points, normals: Points) -> FloatArray:
    """(n, t) monomials of places times each component of the normals."""
    powers = [power for power in product(range(_DEGREE + 1), repeat=3) if sum(power) <= _DEGREE]
    monomials = np.stack([np.prod(places**power, axis=1) for power in powers], axis=1)
    return np.asarray((monomials[:, :, None] * normals[:, None, :]).reshape(len(places), -1))
