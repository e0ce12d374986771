"""Where parts of a surface may hide one another, against all intersections of every ray; what a kept view remembers."""

import numpy as np
import pytest
from kinematic_double import FISHEYE, HEIGHT, LENS, OBLIQUE, SIDES, WIDTH, optics, pixel_centres, sheet

from synth.flow.exact import exact_flow
from synth.flow.overlap import boundary_edges, may_overlap
from synth.flow.view import View
from synth.surface import ContactFaces, GelSurface

SURFACE = sheet(28, 21, 40.0, 30.0)
SIZE = WIDTH, HEIGHT


def _bump(height: float, radius: float, steep: float) -> np.ndarray:
    """A hill of the sheet that leans to the right; where it is steep it overhangs."""
    x, y, _ = SURFACE.material.T
    hill = np.exp(-((((x - 1) ** 2 + y**2) / radius**2) ** steep))
    return SURFACE.material + np.column_stack([0.8 * height * hill, 0 * hill, height * hill])


STATES = {"flat": SURFACE.material, "gentle": _bump(1.0, 3.0, 1.0), "overhanging": _bump(2.5, 2.5, 4.0)}


def _meetings(positions, triangles, camera):
    """How many triangles the ray of every third pixel's centre goes through, (H, W); 1 for the others.

    Volumes of tetrahedra say on which side of an edge a ray passes. Rays within 1e-6 of an edge alone get 1, too.
    """
    origins, directions = camera.rays(pixel_centres().reshape(-1, 2))
    a, b, c = (positions[triangles[:, i]] for i in range(3))
    count = np.ones(len(origins), dtype=int)
    for n in range(0, len(origins), 3):
        o, d = origins[n], directions[n]
        sides = np.stack([np.cross(p - o, q - o) @ d for p, q in ((a, b), (b, c), (c, a))])
        share = sides / sides.sum(axis=0)
        count[n] = (share > -1e-6).all(axis=0).sum() if (share > 1e-6).all(axis=0).any() else 1
    return count.reshape(HEIGHT, WIDTH)


@pytest.mark.parametrize("view", [{}, {"index": 1.45, "distortion": LENS}, {"index": 1.41, **OBLIQUE}, FISHEYE])
@pytest.mark.parametrize("state", STATES)
def test_every_ray_that_meets_the_surface_more_than_once_is_found(state: str, view: dict) -> None:
    """Fails with every triangle taken to face the camera: the overhang's pixels are not found."""
    camera = optics(**view)
    triangles = SURFACE.triangles
    found = may_overlap(STATES[state], triangles, boundary_edges(triangles), camera, SIZE)
    many = _meetings(STATES[state], triangles, camera) > 1
    assert many.any() == (state == "overhanging")
    assert found[many].all()
    if not found.all():  # a lens's field may end before the sheet does
        assert found.any() == many.any()
        assert found.mean() < 0.5
    if "distortion" not in view:
        assert not found.all()


@pytest.mark.parametrize("size", [(40.0, 30.0), (3.0, 2.0)])
def test_one_sheet_above_another(size: tuple[float, float]) -> None:
    """Two pieces that both face the camera.

    Fails with any winding number allowed: the large piece, whose edges are not seen. Fails with edges allowed in the
    picture: the small one.
    """
    upper = sheet(24, 18, *size)
    lower, shift = SURFACE.material, np.array([4.0, 2.0, 1.0])
    positions = np.concatenate([lower, upper.material + (shift if size[0] < 10 else [0, 0, 1.0])])
    triangles = np.concatenate([SURFACE.triangles, upper.triangles + len(lower)]).astype(np.int32)
    camera = optics()
    found = may_overlap(positions, triangles, boundary_edges(triangles), camera, SIZE)
    many = _meetings(positions, triangles, camera) > 1
    assert many.sum() > 15
    assert found[many].all()


def test_mirrors_are_always_looked_at() -> None:
    camera = optics(mirrors=SIDES)
    assert may_overlap(SURFACE.material, SURFACE.triangles, boundary_edges(SURFACE.triangles), camera, SIZE).all()


@pytest.mark.parametrize("view", [{}, {"mirrors": SIDES}, {"index": 1.45, "distortion": LENS}])
def test_a_kept_view_gives_what_a_new_one_gives(view: dict) -> None:
    """Fails with a state recognised by its shape: every pair gets the first one's hits."""
    camera, states = optics(**view), list(STATES.values())
    kept = View(SURFACE, camera, *SIZE)
    for i, j in ((0, 1), (1, 2), (2, 0), (0, 1), (2, 1)):
        first, second = (
            exact_flow(SURFACE, states[i], states[j], camera, *SIZE, depth=True, view=used) for used in (kept, None)
        )
        for name in ("forward", "forward_visible", "backward", "backward_visible"):
            np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        np.testing.assert_array_equal(first.extras["depth1.Z"], second.extras["depth1.Z"])


def test_a_view_of_something_else_is_refused() -> None:
    """Fails with any one of the four left out of the comparison."""
    camera = optics()
    view, same = View(SURFACE, camera, *SIZE), (SURFACE.material, SURFACE.material)
    twin = GelSurface(ContactFaces(SURFACE.coarse.nodes, SURFACE.coarse.faces), SURFACE.subdivisions)
    exact_flow(SURFACE, *same, camera, *SIZE, view=view)
    for other in ((twin, *same, camera, *SIZE), (SURFACE, *same, optics(), *SIZE)):
        with pytest.raises(ValueError, match="another surface, camera or size"):
            exact_flow(*other, view=view)
    for size in ((WIDTH - 1, HEIGHT), (WIDTH, HEIGHT - 1)):
        with pytest.raises(ValueError, match="another surface, camera or size"):
            exact_flow(SURFACE, *same, camera, *size, view=view)
