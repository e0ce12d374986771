"""Exact flow and visibility: closed forms, folds and borders, and the independent camera of `verify`."""

import kinematic_double as double
import numpy as np
import pytest
from commands import refused
from kinematic_double import HEIGHT, WIDTH, dented, folded, optics, pixel_centres, rigid, rotation, sensor, sheet
from scipy.optimize import brentq
from verified_sample import motion_checks, sheets

from synth.flow.exact import exact_flow
from synth.flow.view import View
from synth.mesh import rest_surface
from synth.scene import DomeGel, PlaneWindow
from synth.verify.motion import check_motion

REST = rigid(np.eye(3), (0, 0, 0))
MOTIONS = {
    "translation": rigid(np.eye(3), (0.7, -0.4, 0.0)),
    "lift": rigid(np.eye(3), (0.1, 0.0, 1.5)),
    "turn": rigid(rotation("z", 7.0), (0.1, 0.2, 0.0)),
    "tilt": rigid(rotation("x", 5.0) @ rotation("y", -4.0), (0.0, 0.3, 0.6)),
}
ROUNDING = 1e-6
"""px; flow is stored as float32, whose spacing below 16 px is 1e-6. The double-precision error is near 1e-12."""


def _flow(camera, motion1, motion2, **options):
    surface = sheet(7, 6, 40.0, 30.0, 2)  # fills the view
    return exact_flow(View(surface, camera), motion1(surface.material), motion2(surface.material), **options)


def _homography(camera, motion1, motion2):
    """The map from image 1 to image 2 of the plane z = 0 moved from one rigid pose to another: H2 inv(H1)."""
    intrinsic = np.array([[70.0, 0, 31.7], [0, 71.0, 24.4], [0, 0, 1]])
    axes = np.array([camera.pose.right, camera.pose.down, camera.pose.forward])

    def plane_to_image(motion):
        origin, x, y = motion(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
        return intrinsic @ axes @ np.column_stack([x - origin, y - origin, origin - camera.pose.position])

    return plane_to_image(motion2) @ np.linalg.inv(plane_to_image(motion1))


@pytest.mark.parametrize("view", [double.STRAIGHT, double.OBLIQUE])
@pytest.mark.parametrize("first", ["rest", "tilt"])
@pytest.mark.parametrize("second", MOTIONS)
def test_pinhole_flow_is_the_planes_homography(view, first, second):
    camera = optics(**view)
    motion1, motion2 = MOTIONS.get(first, REST), MOTIONS[second]
    flow = _flow(camera, motion1, motion2)
    for field, one, two in ((flow.forward, motion1, motion2), (flow.backward, motion2, motion1)):
        homogeneous = np.dstack([pixel_centres(), np.ones((HEIGHT, WIDTH))]) @ _homography(camera, one, two).T
        expected = homogeneous[..., :2] / homogeneous[..., 2:] - pixel_centres()
        np.testing.assert_allclose(field, expected, atol=ROUNDING)


@pytest.mark.parametrize("index", [1.41, 1.8])
@pytest.mark.parametrize("second", ["translation", "lift", "turn"])
def test_window_flow_is_snells_law(index, second):
    """Down to the sheet by angles in closed form, up again by Brent's root of the same angles."""
    flow = _flow(optics(index=index), REST, MOTIONS[second]).forward

    def run(sine, below):
        return 15 * sine / np.sqrt(1 - sine**2) + below * sine / np.sqrt(index**2 - sine**2)

    for row, column in np.random.default_rng(0).integers(0, (HEIGHT, WIDTH), (60, 2)):
        x, y = (column + 0.5 - 31.7) / 70, (row + 0.5 - 24.4) / 71
        tangent = np.hypot(x, y)
        lateral = run(tangent / np.hypot(1, tangent), 9.0) * np.array([x, y]) / tangent
        moved = MOTIONS[second](np.array([[1.0 + lateral[0], -0.5 + lateral[1], 0.0]]))[0]
        arm = moved[:2] - (1.0, -0.5)
        radius = np.hypot(*arm)
        sine = brentq(lambda s, r=radius, z=moved[2]: run(s, 9.0 - z) - r, 0, 0.999, xtol=1e-15, rtol=1e-14)
        slope = sine / np.sqrt(1 - sine**2) * arm / radius
        expected = slope * (70, 71) + (31.7, 24.4) - (column + 0.5, row + 0.5)
        np.testing.assert_allclose(flow[row, column], expected, atol=ROUNDING)


def test_visibility_ends_at_the_image_border_and_no_motion_is_zero_flow() -> None:
    shift = 2.4
    flow = _flow(optics(), REST, rigid(np.eye(3), (shift * 24 / 70, 0, 0)))
    column = np.arange(WIDTH) + 0.5
    np.testing.assert_array_equal(flow.forward_visible, np.tile(column + shift < WIDTH, (HEIGHT, 1)))
    np.testing.assert_array_equal(flow.backward_visible, np.tile(column - shift >= 0, (HEIGHT, 1)))
    np.testing.assert_allclose(flow.forward[..., 0], shift, atol=ROUNDING)  # also where it has left the image
    flow = _flow(optics(index=1.45, distortion=double.LENS, **double.OBLIQUE), MOTIONS["tilt"], MOTIONS["tilt"])
    np.testing.assert_allclose(flow.forward, 0, atol=1e-10)
    np.testing.assert_array_equal(flow.forward_visible, 1)


def test_pixels_beside_the_gel_are_nan_and_extra_channels_closed_forms() -> None:
    surface = sheet(4, 4, 8.0, 6.0)
    moved = rigid(np.eye(3), (0.3, 0, 0))(surface.material)
    flow = exact_flow(View(surface, optics()), surface.material, moved, depth=True, displacement=True)
    centre = pixel_centres()
    x, y = (centre[..., 0] - 31.7) / 70 * 24 + 1.0, (centre[..., 1] - 24.4) / 71 * 24 - 0.5
    on_gel = (abs(x) <= 4) & (abs(y) <= 3)
    for channel in (*np.moveaxis(flow.forward, 2, 0), flow.extras["depth1.Z"], flow.extras["displacement.Z"]):
        np.testing.assert_array_equal(np.isfinite(channel), on_gel)
    np.testing.assert_array_equal(flow.forward_visible, on_gel)
    np.testing.assert_array_equal(np.isfinite(flow.backward[..., 0]), (abs(x - 0.3) <= 4) & (abs(y) <= 3))
    surface = sheet(10, 8, 40.0, 30.0, 2)
    tilt = rotation("x", 20.0)
    moved = surface.material @ tilt.T + (0, 0, 1.0)
    traction = np.column_stack([surface.material[:, 0], 2 * surface.material[:, 1], np.ones(len(surface.material))])
    camera = optics(**double.OBLIQUE)
    flow = exact_flow(
        View(surface, camera), surface.material, moved,
        backward=False, depth=True, normal=True, displacement=True,
        traction=traction, contact=lambda material, moved: (material[:, 0] > 0) & (moved[:, 1] < 4.0),
    )  # fmt: skip
    assert flow.backward is flow.backward_visible is None
    at = camera.look(camera.centres).on_flat_face

    def channels(name):
        return np.stack([flow.extras[f"{name}.{axis}"] for axis in "XYZ"], axis=-1).reshape(-1, 3)

    single = 2e-6  # float32 of values below 32
    depth = (at - camera.pose.position) @ camera.pose.forward
    np.testing.assert_allclose(flow.extras["depth1.Z"].ravel(), depth, atol=single)
    np.testing.assert_allclose(channels("normal1"), np.tile([0, 0, 1], (len(at), 1)), atol=single)
    np.testing.assert_allclose(channels("normal2"), np.tile(tilt @ [0, 0, 1], (len(at), 1)), atol=single)
    np.testing.assert_allclose(channels("displacement"), at @ tilt.T + (0, 0, 1.0) - at, atol=single)
    np.testing.assert_allclose(channels("traction"), at * (1, 2, 0) + (0, 0, 1), atol=2 * single)
    touching = (at[:, 0] > 0) & ((at @ tilt.T)[:, 1] < 4.0)  # at each pixel's own point, not at vertices
    assert 0 < touching.sum() < (at[:, 0] > 0).sum()
    np.testing.assert_array_equal(flow.extras["contact.Y"].ravel(), touching)
    surface = sheet(2, 2, 4.0, 4.0)
    view, rest = View(surface, optics()), surface.material
    refused("positions2 has shape", exact_flow, view, rest, rest[:-1])


@pytest.mark.parametrize("index", [1.0, 1.45])
def test_a_fold_hides_what_lies_under_it(index):
    """The sheet's right half folds over at x = 2: it then covers 0 < x < 2 from a height of 1 mm."""
    surface = sheet(160, 40, 16.0, 12.0)
    camera = optics(index=index)
    flow = exact_flow(View(surface, camera), surface.material, folded(surface.material))
    at = camera.look(camera.centres).on_flat_face.reshape(HEIGHT, WIDTH, 3)
    on_gel = (abs(at[..., 0]) < 8) & (abs(at[..., 1]) < 6)
    # The flap's far edge, at 2 - 6/3 = 0 and 1 mm up, hides points right of where the ray over it meets z = 0; its
    # crease at x = 2 stays put, so points left of the edge's shadow are seen and flat points right of it hidden.
    edge = camera.project(np.array([[0.0, y, 1.0] for y in np.linspace(-5, 5, 21)]))
    hidden = (at[..., 0] < 1.9) & on_gel
    for row in range(HEIGHT):
        shadow = np.interp(row + 0.5, edge[:, 1], edge[:, 0])
        hidden[row] &= np.arange(WIDTH) + 0.5 > shadow
    inner = abs(at[..., 1]) < 4.5
    left = on_gel & inner & (at[..., 0] < 1.9)
    assert 50 < hidden[left].sum() < left.sum() - 200
    np.testing.assert_array_equal(flow.forward_visible[left] == 0, hidden[left])
    np.testing.assert_allclose(flow.forward[left], 0, atol=ROUNDING)  # the true motion, hidden or not
    assert (flow.forward_visible[on_gel & inner & (at[..., 0] > 2.4)] == 1).all()  # the flap itself is on top
    # Backward, the flap's pixels go to where their material was in the flat state, and are seen there.
    flap = np.abs(flow.backward[..., 0]) > 0.5
    assert flap.sum() > 50
    assert (flow.backward_visible[flap & inner] == 1).all()


VIEWS = {
    "air": {},
    "window": {"index": 1.45, "distortion": double.LENS, **double.OBLIQUE},
    "mirrors": {"index": 1.45, "mirrors": double.SIDES, "distortion": double.LENS, "fx": 40.0, "fy": 41.0},
    "mirrors in air": {"mirrors": double.SIDES, "fx": 40.0, "fy": 41.0},
    "periscope": {"index": 1.41, **double.PERISCOPE_VIEW},
    "fisheye": {"index": 1.45, **double.OBLIQUE, **double.FISHEYE},
    "fisheye and mirrors": {"index": 1.45, "mirrors": double.SIDES, **double.FISHEYE, "fx": 35.0, "fy": 35.0},
}

DOME = DomeGel(shape="dome", size_mm=(20, 15, 8), youngs_modulus_kpa=200, dome_radius_mm=17.0)
"""Slopes up to 47 degrees; 2.5 mm are left at its corners."""
DOME_VIEWS = {
    "window": VIEWS["window"],
    "fisheye": VIEWS["fisheye"],
    "close fisheye": {"index": 1.41, **double.FISHEYE, "fx": 34.0, "fy": 34.0, "position_mm": (0.3, -0.2, 12.0)},
    "fisheye and mirrors": VIEWS["fisheye and mirrors"],
}


def _paths(view):
    return optics(**VIEWS[view]).look(pixel_centres().reshape(-1, 2)).path.reshape(HEIGHT, WIDTH)


def _agreed(sensor, surface, first, second, rounding):
    """The flow between two states, which the independent projections must find, too."""
    flow, checks = motion_checks(sensor, surface, first, second)
    assert np.nanmax(np.linalg.norm(flow.forward, axis=2)) > 1.5
    for name, check in checks.items():
        assert check.passed, check
        assert check.figure < rounding or not name.endswith(("flow", "closure")), check
    return flow


@pytest.mark.parametrize("view", VIEWS)
def test_flow_is_the_independent_projections(view):
    """Reflected points, Fermat's principle and OpenCV's lenses against virtual cameras, Snell's law and own lenses."""
    surface = sheet(30, 22, 20.0, 15.0, 2)
    states = dented(surface.material, 0.3), dented(surface.material, 1.1, (0.8, -0.5))
    flow = _agreed(sensor(**VIEWS[view]), surface, *states, 1e-6)  # float32 of 8 px; the promise is 1e-3
    if "mirrors" in view:
        assert all((flow.forward_visible[_paths(view) == k] == 1).sum() > 100 for k in (0, 1, 2))


@pytest.mark.parametrize("view", DOME_VIEWS)
def test_flow_of_a_dome_is_the_independent_projections(view):
    window = PlaneWindow(refractive_index=DOME_VIEWS[view]["index"], thickness_mm=1.0)
    domed, surface = sensor(**DOME_VIEWS[view]).model_copy(update={"gel": DOME, "window": window}), rest_surface(DOME)
    for first in (surface.material, dented(surface.material, 0.3)):
        flow = _agreed(domed, surface, first, dented(surface.material, 1.1, (0.8, -0.5)), 2e-6)  # of 16 px
        assert np.isfinite(flow.forward[..., 0]).mean() > 0.45  # by mirrors some pixels look beside the pad


@pytest.mark.parametrize("view", ["air", "window", "mirrors", "fisheye and mirrors"])
def test_folds_pass_and_their_visibility_is_checked(view):
    """The sheet folds over at x = 3 and covers 0 < x < 3 from 1 mm above, of which either mirror sees a part."""
    surface = sheet(40, 24, 20.0, 15.0, 2)
    states = surface.material, folded(surface.material, 3.0, 3 / 7) + np.array([0.0, 0.3, 0.0])
    flow, checks = motion_checks(sensor(**VIEWS[view]), surface, *states)
    assert all(check.passed for check in checks.values()), [check for check in checks.values() if not check.passed]
    hidden = (flow.forward_visible == 0) & np.isfinite(flow.forward[..., 0])
    assert all(hidden[_paths(view) == k].sum() > 10 for k in ((1, 2) if "mirrors" in view else (0,)))
    wrong = flow.forward_visible.copy()
    places = np.argwhere(hidden)
    wrong[tuple(places[len(places) // 2])] = 1
    near, far = sheets(sensor(**VIEWS[view]), surface, *states)
    checks = {check.name: check for check in check_motion("forward", near, far, flow.forward, wrong)}
    assert not checks["forward visibility"].passed


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
