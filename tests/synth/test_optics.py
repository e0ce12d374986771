"""The camera against OpenCV's lens, Snell's law in angles, and its own inverse."""

import cv2
import numpy as np
import pytest
from kinematic_double import LENS, OBLIQUE, STRAIGHT, optics, sensor
from scipy.optimize import brentq

from synth.errors import InputError
from synth.optics import Optics

RNG = np.random.default_rng(3)
POINTS = RNG.uniform((-7, -5, 0), (7, 5, 4), (200, 3))
PIXELS = RNG.uniform((-3, -3), (67, 51), (300, 2))


@pytest.mark.parametrize("index", [1.0, 1.41, 2.2])
@pytest.mark.parametrize("view", [STRAIGHT, OBLIQUE])
@pytest.mark.parametrize("lens", [(0.0,) * 5, LENS, (0.3, 0.0, 0.0, 0.0, 0.0)])
def test_project_inverts_rays(index, view, lens):
    camera = optics(index=index, distortion=lens, **view)
    origins, directions = camera.rays(PIXELS)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-14)
    start = 0.0 if index > 1 else 14.0  # from the camera's position, stay inside the sensor
    for distance in (start, start + 2.5, start + 8.0):
        points = origins + distance * directions
        # Rounding: some 1e-15 relative at 100 px, a few tens of operations.
        np.testing.assert_allclose(camera.project(points), PIXELS, atol=1e-10)


def test_image_axes():
    camera = optics()
    right, down = camera.project(np.array([[1.0, -0.5, 0.0], [2.0, -0.5, 0.0], [1.0, 0.5, 0.0]]))[1:] - (31.7, 24.4)
    np.testing.assert_allclose(right, (70 / 24, 0), atol=1e-12)  # +x is right in the image
    np.testing.assert_allclose(down, (0, 71 / 24), atol=1e-12)  # +y is down


def test_lens_is_opencvs():
    camera = optics(distortion=LENS, **OBLIQUE)
    mirror = np.array([1.0, 1.0, -1.0])  # OpenCV's world is right-handed
    axes = np.array([camera.pose.right, camera.pose.down, camera.pose.forward]) * mirror
    matrix = np.array([[70.0, 0, 31.7], [0, 71.0, 24.4], [0, 0, 1]])
    shift = -axes @ (camera.pose.position * mirror)
    expected, _ = cv2.projectPoints(POINTS * mirror, cv2.Rodrigues(axes)[0], shift, matrix, np.array(LENS))
    np.testing.assert_allclose(camera.project(POINTS), expected[:, 0], atol=1e-11)


@pytest.mark.parametrize("index", [1.2, 1.45, 2.5])
def test_refraction_is_snells_law_in_angles(index):
    """Another formulation: root of the lateral run in the angle of incidence, by Brent's method."""
    camera = optics(index=index)
    for point, pixel in zip(POINTS, camera.project(POINTS), strict=True):
        dx, dy, below = point[0] - 1.0, point[1] + 0.5, 9.0 - point[2]
        distance = np.hypot(dx, dy)

        def beyond(angle, below=below, distance=distance):
            return 15.0 * np.tan(angle) + below * np.tan(np.arcsin(np.sin(angle) / index)) - distance

        angle = brentq(beyond, 0, 1.5, xtol=1e-15, rtol=1e-15)
        around = np.arctan2(dy, dx)
        expected = 70 * np.tan(angle) * np.cos(around) + 31.7, 71 * np.tan(angle) * np.sin(around) + 24.4
        np.testing.assert_allclose(pixel, expected, atol=1e-10)


def test_index_one_ignores_the_window():
    thin, none = optics(index=1 + 1e-12), optics(index=1)
    np.testing.assert_allclose(
        thin.project(POINTS), none.project(POINTS), atol=1e-9
    )  # slope ~ 100 px per unit of index


def test_grazing_and_axial_points():
    camera = optics(index=1.5)
    points = np.array([[1.0, -0.5, 0.0], [1.0 + 1e-9, -0.5, 0.0], [5000.0, -0.5, 8.999], [50.0, 30.0, 9.0]])
    pixels = camera.project(points)
    np.testing.assert_allclose(pixels[0], (31.7, 24.4), atol=1e-12)
    np.testing.assert_allclose(pixels[1, 0] - 31.7, 70e-9 / (15 + 9 / 1.5), rtol=1e-4)  # paraxial; 31.7 has 1e-14 left
    origins, directions = camera.rays(pixels[2:])
    reach = (points[2:, 2] - origins[:, 2]) / directions[:, 2]
    lateral = (origins + reach[:, None] * directions)[:, :2]
    np.testing.assert_allclose(lateral, points[2:, :2], rtol=1e-9)


def test_nan_where_no_image_or_ray_exists():
    camera = optics(index=1.45, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))  # turns back at radius 1.054, value 0.703
    assert np.isnan(camera.project(np.array([[0.0, 0.0, 9.5]]))).all()  # above the window
    assert np.isnan(camera.project(np.array([[40.0, 0.0, 8.0]]))).all()  # beyond the lens model's field
    assert np.isnan(optics().project(np.array([[0.0, 0.0, 30.0]]))).all()  # behind the camera
    reach = 31.7 + 70 * np.array([0.70, 0.71])
    origins, directions = camera.rays(np.column_stack([reach, [24.4, 24.4]]))
    assert np.isfinite(origins[0]).all()
    assert np.isnan(origins[1]).all()
    assert np.isnan(directions[1]).all()
    level = optics(position_mm=(0, 0, 10), look_at_mm=(0.0, 30.0, 9.0))  # toward +y, so the image's down is +z
    np.testing.assert_array_equal(
        np.isnan(level.rays(np.array([[31.7, 24.4], [31.7, 224.0]]))[1]).all(1), [False, True]
    )


def test_rejects_a_view_along_x():
    with pytest.raises(InputError, match="looks along x"):
        Optics.of(sensor(position_mm=(0.0, 0.0, 10.0), look_at_mm=(1e8, 0.0, 9.0)))
