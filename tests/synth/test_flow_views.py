"""Flow and visibility by mirrors and fisheye lenses: closed forms, and the independent camera of `verify`."""

import numpy as np
import pytest
from kinematic_double import (
    FISHEYE,
    HEIGHT,
    LENS,
    LEVEL,
    OBLIQUE,
    PERISCOPE,
    SIDES,
    WIDTH,
    dented,
    folded,
    optics,
    pixel_centres,
    sensor,
    sheet,
)
from verified_sample import motion_checks, sheets

from synth.flow.exact import exact_flow
from synth.mesh import rest_surface
from synth.scene import Gel, Window
from synth.verify.motion import check_motion

VIEWS = {
    "window": {"index": 1.45, "distortion": LENS, **OBLIQUE},
    "mirrors": {"index": 1.45, "mirrors": SIDES, "distortion": LENS, "fx": 40.0, "fy": 41.0},
    "mirrors in air": {"mirrors": SIDES, "fx": 40.0, "fy": 41.0},
    "periscope": {"index": 1.41, "mirrors": PERISCOPE, **LEVEL},
    "fisheye": {"index": 1.45, **OBLIQUE, **FISHEYE},
    "fisheye and mirrors": {"index": 1.45, "mirrors": SIDES, **FISHEYE, "fx": 35.0, "fy": 35.0},
}


DOME = Gel(shape="dome", size_mm=(20, 15, 8), youngs_modulus_kpa=200, dome_radius_mm=17.0)
"""Slopes up to 47 degrees; 2.5 mm are left at its corners."""
DOME_VIEWS = {
    "window": VIEWS["window"],
    "fisheye": VIEWS["fisheye"],
    "close fisheye": {"index": 1.41, **FISHEYE, "fx": 34.0, "fy": 34.0, "position_mm": (0.3, -0.2, 12.0)},
    "fisheye and mirrors": VIEWS["fisheye and mirrors"],
}


def _paths(view):
    """(HEIGHT, WIDTH) by which mirror each pixel looks."""
    return optics(**VIEWS[view]).look(pixel_centres().reshape(-1, 2)).path.reshape(HEIGHT, WIDTH)


@pytest.mark.parametrize("view", VIEWS)
def test_flow_is_the_independent_projections(view):
    """Reflected points, Fermat's principle and OpenCV's lenses against virtual cameras, Snell's law and own lenses."""
    surface = sheet(30, 22, 20.0, 15.0, 2)
    flow, checks = motion_checks(
        sensor(**VIEWS[view]), surface, dented(surface.material, 0.3), dented(surface.material, 1.1, (0.8, -0.5))
    )
    assert np.nanmax(np.linalg.norm(flow.forward, axis=2)) > 1.5
    for name, check in checks.items():
        assert check.passed, check
        if name.endswith(("flow", "closure")):
            assert check.figure < 1e-6  # float32 of motions below 8 px; the promise is 1e-3
    if "mirrors" in view:
        assert all((flow.forward_visible[_paths(view) == k] == 1).sum() > 100 for k in (0, 1, 2))


@pytest.mark.parametrize("view", DOME_VIEWS)
def test_flow_of_a_dome_is_the_independent_projections(view):
    """The pad of the other tests with a dome, its window's outer face where it was."""
    window = Window(refractive_index=DOME_VIEWS[view]["index"], thickness_mm=1.0)
    domed, surface = sensor(**DOME_VIEWS[view]).model_copy(update={"gel": DOME, "window": window}), rest_surface(DOME)
    for first in (surface.material, dented(surface.material, 0.3)):
        flow, checks = motion_checks(domed, surface, first, dented(surface.material, 1.1, (0.8, -0.5)))
        assert np.nanmax(np.linalg.norm(flow.forward, axis=2)) > 1.5
        assert np.isfinite(flow.forward[..., 0]).mean() > 0.45  # by mirrors some pixels look beside the pad
        for name, check in checks.items():
            assert check.passed, check
            if name.endswith(("flow", "closure")):
                assert check.figure < 2e-6  # float32 of motions below 16 px; the promise is 1e-3


@pytest.mark.parametrize("view", ["mirrors", "fisheye and mirrors"])
def test_folds_in_mirrors_are_hidden_rightly(view):
    """The sheet folds over at x = 3 and covers 0 < x < 3 from 1 mm above, of which either mirror sees a part."""
    surface = sheet(40, 24, 20.0, 15.0, 2)
    over = folded(surface.material, 3.0, 3 / 7) + np.array([0.0, 0.3, 0.0])
    flow, checks = motion_checks(sensor(**VIEWS[view]), surface, surface.material, over)
    assert all(check.passed for check in checks.values()), [check for check in checks.values() if not check.passed]
    hidden = (flow.forward_visible == 0) & np.isfinite(flow.forward[..., 0])
    assert all(hidden[_paths(view) == k].sum() > 10 for k in (1, 2))


def test_motion_in_an_upright_mirror_in_numbers():
    """An upright mirror at x = 4 faces -x; the camera is at x = 0, its image at x = 8, both 20 mm above the sheet.

    A shift of +0.5 mm in x is seen as 70 · 0.5 / 20 = 1.75 px to the right straight, and as much to the left in the
    mirror. The mirror spans 10 < z < 14, i.e. from 4 / 10 to 4 / 6 of the focal length right of the principal point.
    """
    mirror = {"position_mm": (4.0, 0.0, 12.0), "normal": (-1.0, 0.0, 0.0), "size_mm": (40.0, 4.0)}
    view = {"mirrors": (mirror,), "position_mm": (0.0, 0.0, 20.0), "look_at_mm": (0.0, 0.0, 0.0), "cx": 10.0}
    surface = sheet(6, 6, 60.0, 60.0)
    flow = exact_flow(
        surface, surface.material, surface.material + np.array([0.5, 0, 0]), optics(**view), WIDTH, HEIGHT
    )
    centre = np.arange(WIDTH) + 0.5
    begins, ends = 10 + 70 * 4 / 10, 10 + 70 * 4 / 6  # 38.0 and 56.7
    inside = (centre > begins) & (centre < ends)
    motion = np.where(inside, -1.75, 1.75)
    # float32 of 1.75 is exact; rounding of 100 px in double precision.
    np.testing.assert_allclose(flow.forward[..., 0], np.tile(motion, (HEIGHT, 1)), atol=1e-6)
    np.testing.assert_allclose(flow.forward[..., 1], 0, atol=1e-6)
    end = centre + motion
    stays = np.where(inside, (end > begins) & (end < ends), ((end < begins) | (end > ends)) & (end < WIDTH))
    np.testing.assert_array_equal(flow.forward_visible, np.tile(stays, (HEIGHT, 1)))
    assert 0 < (~stays).sum() < 8
    back = np.where(inside, (centre + 1.75 > begins) & (centre + 1.75 < ends), True)
    assert (flow.backward_visible[:, inside] == back[inside]).all()


def test_verify_finds_a_pixel_that_leaves_its_mirror():
    surface = sheet(30, 22, 20.0, 15.0, 2)
    states = surface.material, surface.material + np.array([0.5, 0.2, 0.0])
    view = VIEWS["mirrors"]
    flow, checks = motion_checks(sensor(**view), surface, *states)
    assert all(check.passed for check in checks.values())
    near, far = sheets(sensor(**view), surface, *states)
    end = pixel_centres() + flow.forward
    inner = (end > 0.1).all(2) & (end < (WIDTH - 0.1, HEIGHT - 0.1)).all(2)
    left = np.argwhere((flow.forward_visible == 0) & (_paths("mirrors") > 0) & inner)
    assert len(left) > 3
    wrong = flow.forward_visible.copy()
    wrong[tuple(left[0])] = 1
    checks = {check.name: check for check in check_motion("forward", near, far, flow.forward, wrong)}
    assert not checks["forward visibility"].passed
    assert checks["forward flow"].passed
