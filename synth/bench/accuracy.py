"""Errors of a press against a reference: displacement of the contact face, and force.

The surface's displacement is compared at a grid of points of the undeformed contact face, interpolated with each mesh's
own shape functions. With u and r the two fields and means over the points, a state's errors are

.. math::  100 sqrt(<|u - r|²> / <|r|²>) in %,    scale · sqrt(<|(u - r)_{xy}|²>) in px of the image

and those of the force, 100 |F_z / R_z - 1| and 100 |F_xy - R_xy| / |R_xy|, in %.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray
from synth.bench.cases import GEL, Case
from synth.simulate import Trajectory
from synth.simulate.probe import probe

GRID = (61, 46)
"""Points of the contact face along x and y, its edges among them."""


@dataclass(frozen=True)
class Answer:
    """What is compared of a press.

    Attributes:
        displacement: (k, g, 3) mm at the grid's points in the k recorded states after the undeformed one.
        force: (k, 3) N.
    """

    displacement: FloatArray
    force: FloatArray


@dataclass(frozen=True)
class Errors:
    """Of each recorded state; NaN for states that were not reached.

    Attributes:
        percent: (k,) of the displacement.
        px: (k,) of the displacement along the face.
        normal: (k,) % of the normal force.
        tangential: (k,) % of the tangential force; NaN where there is next to none.
    """

    percent: FloatArray
    px: FloatArray
    normal: FloatArray
    tangential: FloatArray


def answer(trajectory: Trajectory) -> Answer:
    """The recorded states at the grid's points."""
    x, y = (np.linspace(-length / 2, length / 2, n) for length, n in zip(GEL.size_mm[:2], GRID, strict=True))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    matrix = probe(trajectory.space, points)
    states = trajectory.states[1:]
    displacement = np.array([matrix @ state.displacement for state in states]).reshape(-1, len(points), 3)
    return Answer(displacement, np.array([state.force_n for state in states]).reshape(-1, 3))


def errors(found: Answer, reference: Answer, case: Case, px_per_mm: float) -> Errors:
    """Of an answer whose last states may be missing."""
    reached, count = len(found.force), len(reference.force)
    off = found.displacement - reference.displacement[:reached]
    size = _root_mean_square(reference.displacement[:reached])
    pull, should = found.force, reference.force[:reached]
    normal = 100 * np.abs(pull[:, 2] / should[:, 2] - 1)
    tangential = np.full(reached, np.nan)
    if case.friction > 0:
        size_t = np.linalg.norm(should[:, :2], axis=1)
        tangential = 100 * np.linalg.norm(pull[:, :2] - should[:, :2], axis=1) / size_t
        # Before the drag there is next to no tangential force, and a ratio to it says nothing.
        tangential[size_t < 0.05 * np.abs(should[:, 2])] = np.nan
    rows = (100 * _root_mean_square(off) / size, px_per_mm * _root_mean_square(off[..., :2]), normal, tangential)
    return Errors(*(np.concatenate([row, np.full(count - reached, np.nan)]) for row in rows))


def worst(values: FloatArray, case: Case) -> float:
    """The largest over the judged states; NaN where one of them has no value."""
    return float(np.max(values[list(case.judged)]))


def _root_mean_square(field: FloatArray) -> FloatArray:
    """(k,) of the lengths of the vectors in a (k, g, d) field."""
    return np.asarray(np.sqrt((field**2).sum(axis=2).mean(axis=1)))
