"""Cook's membrane at finite strain, nearly incompressible: a tapered cantilever under shear, the test of locking.

Simo & Armero, Int. J. Numer. Meth. Eng. 33 (1992): corners (0, 0), (48, 44), (48, 60), (0, 44) mm, clamped at x = 0,
μ = 80.1938, a dead shear load of 100 spread evenly over the end, plane strain; here ν = 0.4999 and a slab one element
thick with u_z = 0. The tip is the upper corner of the end.
"""

from functools import cache

import numpy as np
import pytest
from pads import ELEMENT
from problems import equilibrium, face_load, mapped, supported

from synth.arrays import BoolArray, Points
from synth.simulate.material import uniform

POISSON = 0.4999
YOUNG = 80.1938 * 2 * (1 + POISSON)
THICKNESS, END = 1.0, 16.0
CONVERGED = 6.93
"""Tip displacement, mm: what the elements below tend to (P2/P1 at n = 32: 6.922)."""
REFERENCE = {
    ("p2p1", 8): 6.87,
    ("p2p1", 16): 6.908,
    ("p1p1", 8): 6.37,
    ("p1p1", 16): 6.71,
    ("p1p1", 32): 6.85,
    ("p1", 16): 6.32,
}
"""Tip displacement (mm) of another program of ours with the same elements and n cells along each edge."""


def taper(cube: Points) -> Points:
    """The unit cube onto the membrane."""
    x, y, z = cube.T
    return np.column_stack([48 * x, 44 * x + y * (44 - 28 * x), THICKNESS * z])


def clamped(points: Points) -> BoolArray:
    return np.column_stack([points[:, 0] == 0, points[:, 0] == 0, np.ones(len(points), dtype=bool)])


@cache
def tip(element: str, cells: int) -> float:
    """Vertical displacement of the upper corner, mm."""
    # No node lies at z = 2: nothing is bonded.
    mesh = mapped((cells, cells, 1), taper, 2.0)
    space = supported(mesh, ELEMENT[element](), clamped)
    shear = np.array([0.0, 100.0 / (YOUNG * END * THICKNESS), 0.0])
    load = face_load(space, lambda x: np.isclose(x[:, 0], 48.0), shear)
    assert load.sum(axis=0) == pytest.approx([0.0, 100.0 / YOUNG, 0.0])
    _, state, _ = equilibrium(space, uniform(len(mesh.tets), POISSON), load=load, steps=5, tolerance=1e-8)
    corner = np.flatnonzero(np.isclose(space.points, [48.0, 60.0, 0.0]).all(axis=1))
    return float(state.u[corner[0], 1])


@pytest.mark.parametrize(("element", "cells"), REFERENCE)
def test_tip_moves_as_known(element: str, cells: int) -> None:
    known = REFERENCE[element, cells]
    # The other program cuts the cells along other diagonals, which moves a discretisation error by up to a fifth.
    assert tip(element, cells) == pytest.approx(known, abs=0.2 * (CONVERGED - known))


def test_mixed_elements_do_not_lock() -> None:
    """With a quarter of the nodes Taylor-Hood is nearer than P1/P1, and that nearer than displacements alone."""
    error = [CONVERGED - tip(element, 8) for element in ("p2p1", "p1p1", "p1")]
    assert 0 < error[0] < 0.2 * error[1] < 0.2 * 0.5 * error[2]
