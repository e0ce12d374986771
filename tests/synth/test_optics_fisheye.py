"""The fisheye lens against OpenCV's, the equidistant law, and its own inverse."""

import cv2
import numpy as np
import pytest
from kinematic_double import FISHEYE, OBLIQUE, STRAIGHT, optics

from synth.optics.lens_fisheye import FisheyeLens

RNG = np.random.default_rng(5)
PIXELS = RNG.uniform((-3, -3), (67, 51), (300, 2))


def _lens(*distortion: float) -> FisheyeLens:
    return FisheyeLens(np.array([50.0, 52.0]), np.array([31.7, 24.4]), distortion)


@pytest.mark.parametrize("index", [1.0, 1.45])
@pytest.mark.parametrize("view", [STRAIGHT, OBLIQUE])
@pytest.mark.parametrize("coefficients", [(0.0,) * 4, FISHEYE["distortion"], (-0.2, 0.03, 0.0, 0.0)])
def test_project_inverts_rays(index, view, coefficients):
    # Fails with the sign of k2 changed in `_distorted`: the lens then turns back inside the field it claims.
    camera = optics(index=index, **view, **{**FISHEYE, "distortion": coefficients})
    origins, directions = camera.rays(PIXELS)
    start = 0.0 if index > 1 else 14.0  # from the camera's position, stay inside the sensor
    for distance in (start, start + 6.0):
        # Rounding: some 1e-15 relative at 100 px, a few tens of operations.
        np.testing.assert_allclose(camera.project(origins + distance * directions), PIXELS, atol=1e-10)


def test_lens_is_opencvs():
    lens = _lens(0.05, -0.02, 0.004, -0.001)
    angle, around = RNG.uniform(0, 1.5, 400), RNG.uniform(0, 2 * np.pi, 400)
    local = np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
    matrix = np.array([[50.0, 0, 31.7], [0, 52.0, 24.4], [0, 0, 1]])
    coefficients = np.array(lens.distortion)
    expected = cv2.fisheye.projectPoints(local[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    # At 1.5 rad OpenCV divides by z = 0.07 and takes the arctangent: 14 times the rounding of 100 px.
    np.testing.assert_allclose(lens.project(local), expected, atol=1e-11)
    np.testing.assert_allclose(lens.directions(expected), local, atol=1e-12)


def test_without_coefficients_pixels_are_angles():
    angle = np.array([0.0, 0.3, 1.0, 1.57])
    local = np.column_stack([np.sin(angle), 0 * angle, np.cos(angle)])
    np.testing.assert_allclose(_lens(0.0, 0.0, 0.0, 0.0).project(local)[:, 0], 31.7 + 50 * angle, atol=1e-12)


def test_field_ends_where_the_radius_turns_back_or_at_a_right_angle():
    lens = _lens(-0.25, 0.0, 0.0, 0.0)  # 1 - 0.75 θ² = 0 at θ = 1.1547, radius 2/3 of that
    assert lens.field_limit == pytest.approx(np.sqrt(4 / 3), rel=1e-12)
    edge = 31.7 + 50 * 2 / 3 * lens.field_limit
    found = lens.directions(np.array([[edge - 1e-3, 24.4], [edge + 1e-3, 24.4]]))
    np.testing.assert_array_equal(np.isnan(found[:, 0]), [False, True])
    for angle, is_lost in ((1.15, False), (1.16, True)):
        assert np.isnan(lens.project(np.array([[np.sin(angle), 0.0, np.cos(angle)]]))).all() == is_lost
    behind = np.array([[1.0, 0.0, -1e-9], [1.0, 0.0, 1e-3]])
    np.testing.assert_array_equal(np.isnan(_lens(0.0, 0.0, 0.0, 0.0).project(behind)).all(1), [True, False])
