"""Ray tracing: nearest hits, watertight edges; where parts of a surface may hide one another; cached views."""

import numpy as np
import pytest
from kinematic_double import FISHEYE, LENS, OBLIQUE, SIDES, assert_same_flow, optics, pixel_centres, sheet

from synth.flow.exact import exact_flow
from synth.flow.overlap import boundary_edges, may_overlap
from synth.flow.trace import trace
from synth.flow.view import View

RNG = np.random.default_rng(5)
SURFACE = sheet(28, 21, 40.0, 30.0)


def _rough(subdivisions: int = 1) -> tuple[np.ndarray, np.ndarray]:
    surface = sheet(12, 9, 12.0, 9.0, subdivisions)
    return surface.material + RNG.uniform(-0.3, 0.3, surface.material.shape), surface.triangles


def _through(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def test_rays_through_grid_lines_of_a_flat_sheet_beside_it_and_away_from_it() -> None:
    surface = sheet(8, 8, 4.0, 4.0)
    down = np.tile([0.0, 0.0, -1.0], (len(surface.material), 1))
    hits = trace(surface.material, surface.triangles, surface.material - 2 * down, down)
    np.testing.assert_array_equal(hits.distance, 2.0)
    corners = surface.material[surface.triangles]
    touching = (corners == surface.material[:, None, None]).all(3).any(2)
    np.testing.assert_array_equal(hits.triangle, touching.argmax(1))  # of equally near triangles the first
    surface = sheet(2, 2, 4.0, 4.0)
    origins = np.array([[0.3, 0.1, 1.0], [np.nan] * 3, [0.3, 0.1, -1.0], [9.0, 0.0, 1.0], [0.3, 0.1, 1.0]])
    directions = np.array([[0, 0, -1.0], [np.nan] * 3, [0, 0, -1.0], [0, 0, -1.0], [0, 0, 1.0]])
    hits = trace(surface.material, surface.triangles, origins, directions)
    np.testing.assert_array_equal(hits.triangle >= 0, [1, 0, 0, 0, 0])


def _bump(height: float, radius: float, steep: float) -> np.ndarray:
    """A hill of the sheet that leans to the right; where it is steep it overhangs."""
    x, y, _ = SURFACE.material.T
    hill = np.exp(-((((x - 1) ** 2 + y**2) / radius**2) ** steep))
    return SURFACE.material + np.column_stack([0.8 * height * hill, 0 * hill, height * hill])


STATES = {"flat": SURFACE.material, "gentle": _bump(1.0, 3.0, 1.0), "overhanging": _bump(2.5, 2.5, 4.0)}


def _meetings(positions, triangles, camera):
    """How many triangles the ray of every third pixel's centre goes through, (H, W); 1 for the others and at edges."""
    seen = camera.look(pixel_centres().reshape(-1, 2))
    origins, directions = seen.origins, seen.directions
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    count = np.ones(len(origins), dtype=int)
    for n in range(0, len(origins), 3):
        o, d = origins[n], directions[n]
        sides = np.stack([np.cross(p - o, q - o) @ d for p, q in ((a, b), (b, c), (c, a))])
        share = sides / sides.sum(axis=0)
        count[n] = (share > -1e-6).all(axis=0).sum() if (share > 1e-6).all(axis=0).any() else 1
    return count.reshape(pixel_centres().shape[:2])


@pytest.mark.parametrize("view", [{}, {"index": 1.45, "distortion": LENS}, {"index": 1.41, **OBLIQUE}, FISHEYE])
@pytest.mark.parametrize("state", STATES)
def test_every_ray_that_meets_the_surface_more_than_once_is_found(state: str, view: dict) -> None:
    camera = optics(**view)
    triangles = SURFACE.triangles
    found = may_overlap(STATES[state], triangles, boundary_edges(triangles), camera)
    many = _meetings(STATES[state], triangles, camera) > 1
    assert many.any() == (state == "overhanging")
    assert found[many].all()
    if not found.all():  # a lens's field may end before the sheet does
        assert found.any() == many.any()
        assert found.mean() < 0.5
    if "distortion" not in view:
        assert not found.all()


@pytest.mark.parametrize("size", [(40.0, 30.0), (3.0, 2.0)])
def test_one_sheet_above_another_that_faces_the_camera_too(size: tuple[float, float]) -> None:
    upper = sheet(24, 18, *size)
    lower, shift = SURFACE.material, np.array([4.0, 2.0, 1.0])
    positions = np.concatenate([lower, upper.material + (shift if size[0] < 10 else [0, 0, 1.0])])
    triangles = np.concatenate([SURFACE.triangles, upper.triangles + len(lower)]).astype(np.int32)
    camera = optics()
    found = may_overlap(positions, triangles, boundary_edges(triangles), camera)
    many = _meetings(positions, triangles, camera) > 1
    assert many.sum() > 15
    assert found[many].all()


@pytest.mark.parametrize("view", [{}, {"mirrors": SIDES}, {"index": 1.45, "distortion": LENS}])
def test_a_kept_view_gives_what_a_new_one_gives(view: dict) -> None:
    camera, states = optics(**view), list(STATES.values())
    kept = View(SURFACE, camera)
    for i, j in ((0, 1), (1, 2), (2, 0), (0, 1), (2, 1)):
        first, second = (exact_flow(used, states[i], states[j], depth=True) for used in (kept, View(SURFACE, camera)))
        assert_same_flow(first, second)
        np.testing.assert_array_equal(first.extras["depth1.Z"], second.extras["depth1.Z"])


def test_mirrors_are_always_looked_at() -> None:
    camera = optics(mirrors=SIDES)
    assert may_overlap(SURFACE.material, SURFACE.triangles, boundary_edges(SURFACE.triangles), camera).all()
