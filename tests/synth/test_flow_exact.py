"""Exact flow of rigidly moved sheets against closed forms, of folds and borders against what must be seen."""

import numpy as np
import pytest
from kinematic_double import HEIGHT, LENS, OBLIQUE, STRAIGHT, WIDTH, folded, optics, pixel_centres, rotation, sheet
from kinematic_double import rigid as moved_by
from scipy.optimize import brentq

from synth.errors import InputError
from synth.flow.exact import exact_flow

REST = moved_by(np.eye(3), (0, 0, 0))
MOTIONS = {
    "translation": moved_by(np.eye(3), (0.7, -0.4, 0.0)),
    "lift": moved_by(np.eye(3), (0.1, 0.0, 1.5)),
    "turn": moved_by(rotation("z", 7.0), (0.1, 0.2, 0.0)),
    "tilt": moved_by(rotation("x", 5.0) @ rotation("y", -4.0), (0.0, 0.3, 0.6)),
}
ROUNDING = 1e-6
"""px; flow is stored as float32, whose spacing below 16 px is 1e-6. The double-precision error is near 1e-12."""


def _flow(camera, motion1, motion2, **options):
    surface = sheet(7, 6, 40.0, 30.0, 2)  # fills the view
    return exact_flow(surface, motion1(surface.material), motion2(surface.material), camera, WIDTH, HEIGHT, **options)


def _homography(camera, motion1, motion2):
    """The map from image 1 to image 2 of the plane z = 0 moved from one rigid pose to another: H2 inv(H1)."""
    intrinsic = np.array([[70.0, 0, 31.7], [0, 71.0, 24.4], [0, 0, 1]])
    axes = np.array([camera.pose.right, camera.pose.down, camera.pose.forward])

    def plane_to_image(motion):
        origin, x, y = motion(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
        return intrinsic @ axes @ np.column_stack([x - origin, y - origin, origin - camera.pose.position])

    return plane_to_image(motion2) @ np.linalg.inv(plane_to_image(motion1))


@pytest.mark.parametrize("view", [STRAIGHT, OBLIQUE])
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


def test_translation_in_numbers_and_no_motion_is_zero_flow_everywhere_visible():
    moved = _flow(optics(), REST, MOTIONS["translation"]).forward
    np.testing.assert_allclose(moved - (70 * 0.7 / 24, -71 * 0.4 / 24), 0, atol=ROUNDING)
    flow = _flow(optics(index=1.45, distortion=LENS, **OBLIQUE), MOTIONS["tilt"], MOTIONS["tilt"])
    np.testing.assert_allclose(flow.forward, 0, atol=1e-10)
    np.testing.assert_array_equal(flow.forward_visible, 1)


def test_visibility_ends_at_the_image_border():
    shift = 2.4
    flow = _flow(optics(), REST, moved_by(np.eye(3), (shift * 24 / 70, 0, 0)))
    column = np.arange(WIDTH) + 0.5
    np.testing.assert_array_equal(flow.forward_visible, np.tile(column + shift < WIDTH, (HEIGHT, 1)))
    np.testing.assert_array_equal(flow.backward_visible, np.tile(column - shift >= 0, (HEIGHT, 1)))
    np.testing.assert_allclose(flow.forward[..., 0], shift, atol=ROUNDING)  # also where it has left the image


def test_pixels_beside_the_gel_are_nan():
    surface = sheet(4, 4, 8.0, 6.0)
    moved = moved_by(np.eye(3), (0.3, 0, 0))(surface.material)
    flow = exact_flow(surface, surface.material, moved, optics(), WIDTH, HEIGHT, depth=True, displacement=True)
    centre = pixel_centres()
    x, y = (centre[..., 0] - 31.7) / 70 * 24 + 1.0, (centre[..., 1] - 24.4) / 71 * 24 - 0.5
    on_gel = (abs(x) <= 4) & (abs(y) <= 3)
    for channel in (*np.moveaxis(flow.forward, 2, 0), flow.extras["depth1.Z"], flow.extras["displacement.Z"]):
        np.testing.assert_array_equal(np.isfinite(channel), on_gel)
    np.testing.assert_array_equal(flow.forward_visible, on_gel)
    np.testing.assert_array_equal(np.isfinite(flow.backward[..., 0]), (abs(x - 0.3) <= 4) & (abs(y) <= 3))


@pytest.mark.parametrize("index", [1.0, 1.45])
def test_a_fold_hides_what_lies_under_it(index):
    """The sheet's right half folds over at x = 2: it then covers 0 < x < 2 from a height of 1 mm."""
    surface = sheet(160, 40, 16.0, 12.0)
    camera = optics(index=index)
    flow = exact_flow(surface, surface.material, folded(surface.material), camera, WIDTH, HEIGHT)
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


def test_extra_channels():
    surface = sheet(10, 8, 40.0, 30.0, 2)
    tilt = rotation("x", 20.0)
    moved = surface.material @ tilt.T + (0, 0, 1.0)
    traction = np.column_stack([surface.material[:, 0], 2 * surface.material[:, 1], np.ones(len(surface.material))])
    camera = optics(**OBLIQUE)
    flow = exact_flow(
        surface, surface.material, moved, camera, WIDTH, HEIGHT,
        backward=False, depth=True, normal=True, displacement=True,
        traction=traction, contact=surface.material[:, 0] > 0,
    )  # fmt: skip
    assert flow.backward is None
    assert flow.backward_visible is None
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
    clear = abs(at[:, 0]) > 4.0  # beyond a triangle from the jump
    np.testing.assert_array_equal(flow.extras["contact.Y"].ravel()[clear], at[clear, 0] > 0)


def test_wrong_lengths_are_named():
    surface = sheet(2, 2, 4.0, 4.0)
    with pytest.raises(InputError, match="positions2 has shape"):
        exact_flow(surface, surface.material, surface.material[:-1], optics(), WIDTH, HEIGHT)
    with pytest.raises(InputError, match="contact has shape"):
        exact_flow(surface, surface.material, surface.material, optics(), WIDTH, HEIGHT, contact=np.ones(2))
