"""The refined contact surface: one closed sheet that interpolates nodes, keeps affine fields and is of third order."""

import numpy as np
import pytest
from pads import SIZE, area_vectors, brick, contact_faces, crooked

from synth.arrays import FloatArray, Points
from synth.surface import ContactFaces, GelSurface

CROOKED = contact_faces(crooked((3.0, 2.0, 2.0)))
REGULAR = contact_faces(brick(SIZE, (8, 6, 1)))
SUBDIVISIONS = [1, 2, 3, 4, 5]


def edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each edge once, and how many triangles it belongs to."""
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return np.unique(pairs, axis=0, return_counts=True)


@pytest.mark.parametrize("n", SUBDIVISIONS)
@pytest.mark.parametrize("coarse", [CROOKED, REGULAR], ids=["crooked", "regular"])
def test_refined_sheet_is_one_and_conforming(coarse: ContactFaces, n: int) -> None:
    """Every vertex is shared: a rectangle stays one disc (V - E + F = 1) with each inner edge between two triangles."""
    surface = GelSurface(coarse, n)
    pairs, count = edges(surface.triangles)
    assert len(surface.triangles) == n * n * len(coarse.faces)
    assert len(surface.material) - len(pairs) + len(surface.triangles) == 1
    assert set(count) <= {1, 2}
    half = coarse.nodes[:, :2].max(axis=0)
    border = surface.material[pairs[count == 1], :2]
    low, high = (np.isclose(border, end, rtol=0, atol=1e-12).all(axis=1) for end in (-half, half))
    assert (low | high).any(axis=1).all()
    assert (np.unique(surface.triangles) == np.arange(len(surface.material))).all()


@pytest.mark.parametrize("n", SUBDIVISIONS)
def test_triangles_keep_area_and_orientation_nodes_and_affine_fields_their_values(n: int) -> None:
    surface = GelSurface(CROOKED, n)
    area = area_vectors(surface.material, surface.triangles)
    assert (area[:, 2] < 0).all()
    assert -area[:, 2].sum() == pytest.approx(6.0, rel=1e-12)
    whole = np.repeat(area_vectors(CROOKED.nodes, CROOKED.faces)[:, 2], n * n) / n**2
    # The n * n parts of a face follow each other and are equal, to rounding.
    np.testing.assert_allclose(area[:, 2], whole, rtol=1e-9)
    surface, rng = GelSurface(CROOKED, n), np.random.default_rng(1)
    nodal = rng.standard_normal((len(CROOKED.nodes), 3))
    A, b = rng.standard_normal((3, 3)), rng.standard_normal(3)
    affine, wanted = CROOKED.nodes @ A.T + b, surface.material @ A.T + b
    distance = np.linalg.norm(surface.material[:, None] - CROOKED.nodes, axis=2)
    np.testing.assert_allclose(distance.min(axis=0), 0.0, atol=1e-14)
    found = distance.argmin(axis=0)
    for interpolate in (surface.interpolate, surface.interpolate_linear):
        # One product with the weight 1, and the others with exact zeros.
        np.testing.assert_allclose(interpolate(nodal)[found], nodal, atol=1e-15)
        np.testing.assert_allclose(interpolate(affine), wanted, atol=1e-13)
    np.testing.assert_allclose(surface.positions(nodal)[found], CROOKED.nodes + nodal, atol=1e-14)
    np.testing.assert_allclose(surface.positions(affine - CROOKED.nodes), wanted, atol=1e-13)


def smooth(points: Points) -> FloatArray:
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([np.sin(0.8 * x + 0.3 * y), np.cos(0.6 * y), np.exp(0.2 * x) * np.sin(0.5 * y)])


def test_smooth_fields_converge_at_third_order_and_the_map_is_local() -> None:
    """Halving the edges divides the error inside by 8, where linear interpolation divides it by 4."""

    def errors(cells: int) -> tuple[float, ...]:
        coarse = contact_faces(brick((4.0, 4.0, 1.0), (cells, cells, 1)))
        surface = GelSurface(coarse, 4)
        inside = (np.abs(surface.material[:, :2]) <= 1.0).all(axis=1)
        wanted, nodal = smooth(surface.material)[inside], smooth(coarse.nodes)
        both = surface.interpolate(nodal), surface.interpolate_linear(nodal)
        return tuple(float(np.abs(values[inside] - wanted).max()) for values in both)

    (coarse, coarse_linear), (fine, fine_linear) = errors(8), errors(16)
    # The next term of the expansion is an edge length smaller, 0.25 of the leading one at worst: rates 3 and 2, -0.3.
    assert np.log2(coarse / fine) > 2.7
    assert 1.7 < np.log2(coarse_linear / fine_linear) < 2.3
    surface = GelSurface(CROOKED, 2)
    one = np.zeros((len(CROOKED.nodes), 1))
    node = int(np.argmin(np.linalg.norm(CROOKED.nodes, axis=1)))
    one[node] = 1.0
    reached = np.abs(surface.interpolate(one)[:, 0]) > 0
    near = {int(j) for face in CROOKED.faces if node in face for j in face}
    ring = [k for k, face in enumerate(CROOKED.faces) if near & set(map(int, face))]
    allowed = np.unique(surface.triangles.reshape(len(CROOKED.faces), -1)[ring])
    assert reached.any()
    assert set(np.flatnonzero(reached)) <= set(allowed)
