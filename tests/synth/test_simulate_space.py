"""Function spaces and the sparse pattern of their tangent; fields at points of the contact face.

That every entry of the tangent lands where it belongs is in test_simulate_bulk (tangent against differences).
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from commands import refused
from pads import ELEMENT, MIXED, area_vectors, brick, crooked, layered

import synth.simulate.pattern as pattern_module
from benchmarks.probe import probe
from synth.arrays import FloatArray, Points
from synth.mesh import PadMesh
from synth.mesh.element import EDGES
from synth.simulate.pattern import pattern_of
from synth.simulate.space import Space, function_space
from synth.surface import FACE_EDGES, broken_linear_face, quadratic_face

MESH, OTHER = crooked(), crooked(seed=1)
each = pytest.mark.parametrize("element", MIXED)


def space_of(element: str, mesh: PadMesh = MESH) -> Space:
    return function_space(mesh, ELEMENT[element]())


def test_quadratic_nodes_lie_on_the_middles_of_edges_and_none_beside_the_pad() -> None:
    space = space_of("p2p1")
    assert len(np.unique(space.points.round(9), axis=0)) == len(space.points)  # an edge has one node
    for k, (i, j) in enumerate(EDGES):
        ends = space.points[space.nodes[:, [i, j]]].mean(axis=1)
        np.testing.assert_allclose(space.points[space.nodes[:, 4 + k]], ends, atol=1e-15)
    for k, (i, j) in enumerate(FACE_EDGES):
        ends = space.points[space.faces[:, [i, j]]].mean(axis=1)
        np.testing.assert_allclose(space.points[space.faces[:, 3 + k]], ends, atol=1e-15)
    beside = np.array([[0.0, 0.0], [MESH.size_mm[0] / 2 + 0.01, 0.0]])
    refused("no point of the contact face", probe, space_of("p1p1"), beside)


@each
def test_the_window_is_held_other_faces_can_touch_and_the_face_at_z_0_is_coated_and_probed(element: str) -> None:
    space = space_of(element)
    assert (space.held == (space.points[:, 2] == MESH.size_mm[2])[:, None]).all()
    x, y, z = MESH.size_mm
    normal = area_vectors(space.points, space.faces)
    assert np.linalg.norm(normal, axis=1).sum() == pytest.approx(x * y + 2 * (x + y) * z)
    # Out of the gel, and closed but for the window: the area vectors add up to minus the window's.
    np.testing.assert_allclose(normal.sum(axis=0), [0, 0, -x * y], atol=1e-12)
    assert (np.einsum("fc,fc->f", normal, space.points[space.faces[:, 0]] - [0, 0, z / 2]) > 0).all()
    surface = space.surface
    assert (surface.nodes == space.points[space.surface_nodes]).all()
    assert (surface.nodes[:, 2] == 0).all()
    assert len(surface.nodes) == (space.points[:, 2] == 0).sum()
    normal = area_vectors(surface.nodes, surface.faces)
    assert (normal[:, 2] < 0).all()
    assert normal[:, 2].sum() == pytest.approx(-MESH.size_mm[0] * MESH.size_mm[1])
    values = np.random.default_rng(3).standard_normal(len(space.points))
    nodes = space.surface_nodes
    np.testing.assert_allclose(probe(space, space.points[nodes, :2]) @ values, values[nodes], atol=1e-12)


@each
def test_pressure_is_doubled_at_interfaces(element: str) -> None:
    mesh = brick((4.0, 4.0, 3.0), (2, 2, 3))
    plain, double = space_of(element, mesh), space_of(element, layered(mesh, interface=1.0))
    assert plain.pressures == len(mesh.points)
    assert double.pressures == len(mesh.points) + (mesh.points[:, 2] == 1).sum()
    assert (double.points == plain.points).all()
    assert (double.nodes == plain.nodes).all()
    # No pressure unknown belongs to two layers or to two vertices.
    owner = np.stack([np.repeat(layered(mesh).layer, 4), mesh.tets.ravel()], axis=1)
    pairs = np.unique(np.column_stack([double.pressure_nodes.ravel(), owner]), axis=0)
    assert (pairs[:, 0] == np.arange(double.pressures)).all()


@pytest.mark.parametrize("shape", [quadratic_face, broken_linear_face])
def test_shape_functions_are_a_partition_of_unity(shape: Callable[[FloatArray], FloatArray]) -> None:
    corners = np.eye(3)
    nodes = np.array([*corners, *(corners[[i, j]].mean(axis=0) for i, j in FACE_EDGES)])
    at = np.concatenate([np.random.default_rng(0).dirichlet(np.ones(len(corners)), 500), nodes])
    values = shape(at)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(values[500:], np.eye(len(nodes)), atol=1e-15)
    np.testing.assert_allclose(values @ nodes, at, atol=1e-14)  # affine fields are exact
    if shape is broken_linear_face:
        assert values.min() >= 0


def field(points: Points, degree: int) -> FloatArray:
    x, y = points[:, 0], points[:, 1]
    return 0.3 + 0.7 * x - 0.4 * y + (degree == 2) * (0.2 * x**2 - 0.5 * x * y + 0.1 * y**2)


@pytest.mark.parametrize("element", ["p1p1", "p2p1"])
def test_quadrature_points_are_exact_to_the_order_of_the_element(element: str) -> None:
    """The mean over a tetrahedron of a barycentric coordinate is 1/4, of the product of two (1 + δ) / 20."""
    found = ELEMENT[element]()
    np.testing.assert_allclose(found.barycentric.sum(axis=1), 1, atol=1e-15)
    np.testing.assert_allclose(found.weights @ found.barycentric, np.full(4, 1 / 4), atol=1e-15)
    if element == "p2p1":
        products = np.einsum("q,qa,qb->ab", found.weights, found.barycentric, found.barycentric)
        np.testing.assert_allclose(products, (1 + np.eye(4)) / 20, atol=1e-15)


@pytest.mark.parametrize(("element", "degree"), [("p1p1", 1), ("p2p1", 2)])
def test_probe_reproduces_the_elements_polynomials(element: str, degree: int) -> None:
    space = space_of(element, crooked((6.0, 4.0, 2.0)))
    half = np.array(space.mesh.size_mm[:2]) / 2
    points = np.random.default_rng(2).uniform(-half, half, (300, 2))
    points[:4] = half * [[1, 1], [-1, 1], [1, -1], [-1, -1]]
    points[4] = half * [1, 0.3]
    # Rounding of barycentric coordinates, amplified by a face's aspect ratio.
    np.testing.assert_allclose(probe(space, points) @ field(space.points, degree), field(points, degree), atol=1e-12)


@pytest.fixture(autouse=True)
def _empty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pattern_module, "_CACHED", type(pattern_module._CACHED)())


def others_of(space: Space, count: int) -> list[Space]:
    """Spaces that differ from one, and from each other, in a node that is held or not."""
    held = [space.held.copy() for _ in range(count)]
    for node, mask in enumerate(held):
        mask[node] = ~mask[node]
    return [replace(space, held=mask) for mask in held]


@pytest.mark.parametrize("element", MIXED)
def test_same_topology_shares_the_pattern_and_its_factor(element: str) -> None:
    assert not np.array_equal(MESH.points, OTHER.points)
    one, other = (pattern_of(function_space(mesh, ELEMENT[element]()), True) for mesh in (MESH, OTHER))
    assert one is other
    assert one.factor() is other.factor()
    assert one.factor() is not one.factor(single=False)


def test_what_differs_in_topology_does_not_share() -> None:
    space = function_space(MESH, ELEMENT["p1p1"]())
    shuffled = MESH.tets[np.random.default_rng(0).permutation(len(MESH.tets))]
    others = [
        (space, False),
        (function_space(layered(MESH), ELEMENT["p1p1"]()), True),
        (others_of(space, 1)[0], True),
        (function_space(PadMesh(MESH.points, shuffled, MESH.size_mm), ELEMENT["p1p1"]()), True),
        (function_space(MESH, ELEMENT["p2p1"]()), True),
    ]
    first = pattern_of(space, True)
    for other, mixed in others:
        assert pattern_of(other, mixed) is not first
        assert pattern_of(space, True) is first


def test_only_the_last_few_patterns_and_so_many_entries_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last ones that are together within the bound, and the very last whatever its size."""
    space, large = (function_space(MESH, ELEMENT[element]()) for element in MIXED)
    spaces = others_of(space, pattern_module._MAX_CACHED + 1)
    sizes = [pattern_of(one, True).size for one in spaces]
    assert len(pattern_module._CACHED) == pattern_module._MAX_CACHED
    pattern_module._CACHED.clear()
    monkeypatch.setattr(pattern_module, "_MAX_ENTRIES", sum(sizes[2:]))
    made = [pattern_of(one, True) for one in spaces]
    assert list(pattern_module._CACHED.values()) == made[2:]
    alone = pattern_of(large, True)
    assert alone.size > sum(sizes[2:])
    assert list(pattern_module._CACHED.values()) == [alone]
    assert pattern_of(large, True) is alone
