"""Ray tracing: nearest hits, watertight edges, and independence of order."""

import numpy as np
from kinematic_double import sheet

from synth.flow.trace import trace

RNG = np.random.default_rng(5)


def _rough(subdivisions: int = 1) -> tuple[np.ndarray, np.ndarray]:
    surface = sheet(12, 9, 12.0, 9.0, subdivisions)
    return surface.material + RNG.uniform(-0.3, 0.3, surface.material.shape), surface.triangles


def _through(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays from above through given points, tilted at random."""
    directions = np.column_stack([RNG.uniform(-0.5, 0.5, (len(points), 2)), np.full(len(points), -1.0)])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return points - 9 * directions, directions


def _all_pairs(positions, triangles, origins, directions):
    """Reference: every ray with every triangle, by Cramer's rule on a + v ab + w ac = o + t d."""
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    system = np.stack(np.broadcast_arrays((b - a)[None], (c - a)[None], -directions[:, None]), axis=-1)
    solution = np.linalg.solve(system, (origins[:, None] - a[None])[..., None])[..., 0]
    v, w, t = np.moveaxis(solution, -1, 0)
    t = np.where((v >= -1e-9) & (w >= -1e-9) & (1 - v - w >= -1e-9) & (t >= 0), t, np.inf)
    return np.where(np.isinf(t.min(1)), -1, t.argmin(1)), t.min(1)


def test_agrees_with_all_pairs():
    positions, triangles = _rough()
    origins, directions = _through(RNG.uniform((-7, -5.5, -0.3), (7, 5.5, 0.3), (2000, 3)))
    hits = trace(positions, triangles, origins, directions)
    expected, distance = _all_pairs(positions, triangles, origins, directions)
    np.testing.assert_array_equal(hits.triangle, expected)
    np.testing.assert_allclose(hits.distance, distance, atol=1e-11)  # the reference's solve: condition ~ 1e3
    assert 0.05 < (hits.triangle < 0).mean() < 0.5  # both cases occur
    hit = hits.triangle >= 0
    points = hits.interpolate(triangles, positions)
    np.testing.assert_allclose(points[hit], (origins + directions * hits.distance[:, None])[hit], atol=1e-12)
    assert np.isnan(points[~hit]).all()
    assert np.isnan(hits.barycentric[~hit]).all()


def test_watertight_through_vertices_and_edges():
    """No ray aimed at an inner vertex or at any point of an inner edge falls through."""
    positions, triangles = _rough(2)
    material = sheet(12, 9, 12.0, 9.0, 2).material
    inner = (abs(material[:, 0]) < 5.9) & (abs(material[:, 1]) < 4.4)
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[inner[edges].all(1)]
    share = RNG.uniform(0, 1, (len(edges), 1))
    targets = np.concatenate([positions[inner], (1 - share) * positions[edges[:, 0]] + share * positions[edges[:, 1]]])
    for scale in (1.0, 1e-3, 1e3):
        origins, directions = _through(targets * scale)
        hits = trace(positions * scale, triangles, origins, directions)
        assert (hits.triangle >= 0).all()
        assert (hits.distance <= 9 * (1 + 1e-9)).all()  # at the aim or in front of it


def test_straight_down_through_the_grid_lines_of_a_flat_sheet():
    surface = sheet(8, 8, 4.0, 4.0)
    down = np.tile([0.0, 0.0, -1.0], (len(surface.material), 1))
    hits = trace(surface.material, surface.triangles, surface.material - 2 * down, down)
    np.testing.assert_array_equal(hits.distance, 2.0)
    corners = surface.material[surface.triangles]
    touching = (corners == surface.material[:, None, None]).all(3).any(2)
    np.testing.assert_array_equal(hits.triangle, touching.argmax(1))  # of equally near triangles the first


def test_order_of_triangles_does_not_matter():
    positions, triangles = _rough()
    origins, directions = _through(RNG.uniform((-5, -4, 0), (5, 4, 0), (500, 3)))
    order = RNG.permutation(len(triangles))
    plain = trace(positions, triangles, origins, directions)
    shuffled = trace(positions, triangles[order], origins, directions)
    np.testing.assert_array_equal(np.append(order, -1)[shuffled.triangle], plain.triangle)
    np.testing.assert_array_equal(shuffled.distance, plain.distance)
    np.testing.assert_array_equal(shuffled.barycentric, plain.barycentric)


def test_missing_and_behind():
    surface = sheet(2, 2, 4.0, 4.0)
    origins = np.array([[0.3, 0.1, 1.0], [np.nan] * 3, [0.3, 0.1, -1.0], [9.0, 0.0, 1.0], [0.3, 0.1, 1.0]])
    directions = np.array([[0, 0, -1.0], [np.nan] * 3, [0, 0, -1.0], [0, 0, -1.0], [0, 0, 1.0]])
    hits = trace(surface.material, surface.triangles, origins, directions)
    np.testing.assert_array_equal(hits.triangle >= 0, [1, 0, 0, 0, 0])
