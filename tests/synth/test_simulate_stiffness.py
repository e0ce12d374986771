"""The bulk's tangent where the material changes from element to element.

Each comment "fails with" names a change of `synth.simulate` that was tried.
"""

from dataclasses import replace

import numpy as np
import pytest
from pads import ELEMENT, crooked, dense, far_away

from synth.arrays import FloatArray
from synth.simulate.element import EDGES, Element
from synth.simulate.material import Material, uniform
from synth.simulate.pattern import pattern_of
from synth.simulate.space import function_space
from synth.simulate.system import System
from synth.simulate.tables import laplace_table
from synth.simulate.unknowns import Unknowns

MESH = crooked()
CASES = [("p1p1", 0.2), ("p1p1", 0.45), ("p2p1", 0.2), ("p2p1", 0.45), ("p2p1", 0.5)]
each = pytest.mark.parametrize(("element", "nu"), CASES)
LAWS = np.array([[0.0, 0.0], [0.7, 0.4], [0.0, 0.4], [0.7, 0.0]])
"""c_2 and c_3 of four laws: neo-Hookean, Yeoh, and Yeoh with either term alone."""


def motley(nu: float) -> Material:
    """Another stiffness in each element, one to three times that of E = 1, and the four laws in turn."""
    count = len(MESH.tets)
    share = np.random.default_rng(1).uniform(1.0, 3.0, count)
    even = uniform(count, nu)
    return replace(even, shear=share * even.shear, lame=share * even.lame, yeoh=LAWS[np.arange(count) % 4])


def body_of(element: str, nu: float) -> System:
    body = System(function_space(MESH, ELEMENT[element]()), motley(nu))
    body._barrier = None  # the barrier has a test of its own
    return body


def moved(body: System, size: float, seed: int) -> Unknowns:
    """Random displacements (0 at held nodes) and pressures."""
    rng, zero = np.random.default_rng(seed), body.zero()
    u = size * rng.standard_normal(zero.u.shape)
    u[body.space.held] = 0.0
    return Unknowns(u, rng.standard_normal(zero.p.shape))


def stiffness(body: System, state: Unknowns) -> FloatArray:
    return dense(body, body.tangent(state, far_away()))


@each
def test_tangent_is_the_derivative_of_the_residual(element: str, nu: float) -> None:
    # Fails with the first element's shear modulus in all rows of `laplace_table`, without its volumes, with the table
    # added to the integral where the gel stiffens, and with `stiffens` that looks at c_2 alone.
    body = body_of(element, nu)
    state, h = moved(body, 0.03, 2), 1e-5
    matrix = stiffness(body, state)
    for seed in (3, 4):
        way = moved(body, 1.0, seed)
        ends = [body.residual(state.plus(way, s), far_away()) for s in (h, -h)]
        assert min(end.smallest_jacobian for end in ends) > 0
        difference = (ends[0].free - ends[1].free) / (2 * h)
        along = np.concatenate([way.u.ravel(), way.p.ravel()])[body.free]
        # Central difference: h^2 times third derivatives over first ones, some 1e-10 * 1e3.
        assert np.linalg.norm(matrix @ along - difference) < 1e-6 * np.linalg.norm(difference)


def gradients(element: Element, at: FloatArray, corner: FloatArray) -> FloatArray:
    """(nn, 3) of the displacement's shape functions at barycentric coordinates `at`; the corners' are (4, 3)."""
    if element.order == 1:
        return corner
    corners = [(4 * at[i] - 1) * corner[i] for i in range(4)]
    return np.array(corners + [4 * (at[i] * corner[j] + at[j] * corner[i]) for i, j in EDGES])


@pytest.mark.parametrize("name", ["p1p1", "p2p1"])
def test_laplace_table_is_the_integral(name: str) -> None:
    # Fails without the volumes, with the first element's shear modulus, and with the pair's first node twice.
    element, material = ELEMENT[name](), motley(0.45)
    space = function_space(MESH, element)
    pairs = pattern_of(space, True).element_pairs
    table = laplace_table(space, material, pairs).numpy()
    a = (5 - np.sqrt(5)) / 20  # the rule of four points, exact for products of linear gradients (Hammer et al., 1956)
    points = np.full((4, 4), a) + (1 - 4 * a) * np.eye(4)
    for e, tet in enumerate(MESH.tets):
        corner = np.linalg.inv(np.column_stack([np.ones(4), MESH.points[tet]]))[1:].T
        g = np.array([gradients(element, at, corner) for at in points])
        whole = material.shear[e] * MESH.volumes[e] / 4 * np.einsum("qac,qbc->ab", g, g)
        # Sums of some dozen products, and an inverse of a matrix of condition 10 to 100.
        np.testing.assert_allclose(table[e], whole[pairs[:, 0], pairs[:, 1]], rtol=0, atol=1e-13 * np.abs(whole).max())
