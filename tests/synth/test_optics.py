"""The camera against OpenCV's lenses, Snell's law and the law of reflection in angles, and its own inverse."""

import cv2
import numpy as np
import pytest
from commands import refused
from kinematic_double import FISHEYE, LENS, OBLIQUE, PERISCOPE_VIEW, SIDES, WIDTH, optics, pixel_centres, sensor
from render_scenes import refracted_angle

from synth.optics import Optics
from synth.optics.lens import FisheyeLens

RNG = np.random.default_rng(3)
POINTS = RNG.uniform((-7, -5, 0), (7, 5, 4), (200, 3))
PIXELS = RNG.uniform((-3, -3), (67, 51), (300, 2))

LENSES = {
    "pinhole": {},
    "distorted": {"distortion": LENS},
    "pincushion": {"distortion": (0.3, 0.0, 0.0, 0.0, 0.0)},
    "equidistant": {**FISHEYE, "distortion": (0.0,) * 4},
    "fisheye": FISHEYE,
    "barrel fisheye": {**FISHEYE, "distortion": (-0.2, 0.03, 0.0, 0.0)},
}
CENTRES = pixel_centres().reshape(-1, 2)
VIEWS = {
    "sides": {"mirrors": SIDES, "distortion": LENS, "fx": 40.0, "fy": 41.0},
    "periscope": PERISCOPE_VIEW,
    "fisheye": {"mirrors": SIDES, **FISHEYE, "fx": 35.0, "fy": 35.0},
}


@pytest.mark.parametrize("index", [1.0, 1.41, 2.2])
@pytest.mark.parametrize("view", [{}, OBLIQUE])
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_project_inverts_rays(index, view, lens):
    camera = optics(index=index, **view, **lens)
    seen = camera.look(PIXELS)
    origins, directions = seen.origins, seen.directions
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-14)
    start = 0.0 if index > 1 else 14.0  # from the camera's position, stay inside the sensor
    for distance in (start, start + 2.5, start + 8.0):
        points = origins + distance * directions
        # Rounding: some 1e-15 relative at 100 px, a few tens of operations.
        np.testing.assert_allclose(camera.project(points), PIXELS, atol=1e-10)


def test_lens_is_opencvs():
    camera = optics(distortion=LENS, **OBLIQUE)
    np.testing.assert_allclose(camera.project(POINTS), _by_opencv(camera, POINTS, 70.0, 71.0, LENS), atol=1e-11)


def _by_opencv(camera, points, fx, fy, distortion):
    """Pixels (n, 2) of points (n, 3); OpenCV's world is right-handed."""
    mirror = np.array([1.0, 1.0, -1.0])
    axes = np.array([camera.pose.right, camera.pose.down, camera.pose.forward]) * mirror
    matrix = np.array([[fx, 0, 31.7], [0, fy, 24.4], [0, 0, 1]])
    shift = -axes @ (camera.pose.position * mirror)
    return cv2.projectPoints(points * mirror, cv2.Rodrigues(axes)[0], shift, matrix, np.array(distortion))[0][:, 0]


@pytest.mark.parametrize("index", [1.2, 1.45, 2.5])
def test_refraction_is_snells_law_in_angles(index):
    camera = optics(index=index)
    for point, pixel in zip(POINTS, camera.project(POINTS), strict=True):
        dx, dy = point[0] - 1.0, point[1] + 0.5
        angle = refracted_angle(15.0, 9.0 - point[2], np.hypot(dx, dy), index)
        around = np.arctan2(dy, dx)
        expected = 70 * np.tan(angle) * np.cos(around) + 31.7, 71 * np.tan(angle) * np.sin(around) + 24.4
        np.testing.assert_allclose(pixel, expected, atol=1e-10)


def test_image_axes_and_index_one_ignores_the_window():
    camera = optics()
    right, down = camera.project(np.array([[1.0, -0.5, 0.0], [2.0, -0.5, 0.0], [1.0, 0.5, 0.0]]))[1:] - (31.7, 24.4)
    np.testing.assert_allclose(right, (70 / 24, 0), atol=1e-12)  # +x is right in the image
    np.testing.assert_allclose(down, (0, 71 / 24), atol=1e-12)  # +y is down
    thin, none = (optics(index=index).project(POINTS) for index in (1 + 1e-12, 1))
    np.testing.assert_allclose(thin, none, atol=1e-9)  # slope ~ 100 px per unit of index


def test_grazing_and_axial_points():
    camera = optics(index=1.5)
    points = np.array([[1.0, -0.5, 0.0], [1.0 + 1e-9, -0.5, 0.0], [5000.0, -0.5, 8.999], [50.0, 30.0, 9.0]])
    pixels = camera.project(points)
    np.testing.assert_allclose(pixels[0], (31.7, 24.4), atol=1e-12)
    np.testing.assert_allclose(pixels[1, 0] - 31.7, 70e-9 / (15 + 9 / 1.5), rtol=1e-4)  # paraxial; 31.7 has 1e-14 left
    seen = camera.look(pixels[2:])
    origins, directions = seen.origins, seen.directions
    reach = (points[2:, 2] - origins[:, 2]) / directions[:, 2]
    lateral = (origins + reach[:, None] * directions)[:, :2]
    np.testing.assert_allclose(lateral, points[2:, :2], rtol=1e-9)


def test_nan_where_no_image_or_ray_exists():
    camera = optics(index=1.45, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0))  # turns back at radius 1.054, value 0.703
    above_the_window, beyond_the_lens_models_field = (0.0, 0.0, 9.5), (40.0, 0.0, 8.0)
    assert np.isnan(camera.project(np.array([above_the_window, beyond_the_lens_models_field]))).all()
    assert np.isnan(optics().project(np.array([[0.0, 0.0, 30.0]]))).all()  # behind the camera
    reach = 31.7 + 70 * np.array([0.70, 0.71])
    seen = camera.look(np.column_stack([reach, [24.4, 24.4]]))
    assert np.isfinite(seen.origins[0]).all()
    assert np.isnan([seen.origins[1], seen.directions[1]]).all()
    level = optics(position_mm=(0, 0, 10), look_at_mm=(0.0, 30.0, 9.0))  # toward +y, so the image's down is +z
    directions = level.look(np.array([[31.7, 24.4], [31.7, 224.0]])).directions
    np.testing.assert_array_equal(np.isnan(directions).all(1), [False, True])
    refused("looks along x", Optics.of, sensor(position_mm=(0.0, 0.0, 10.0), look_at_mm=(1e8, 0.0, 9.0)))


def test_a_lens_model_that_rises_again_beyond_its_field_shows_nothing_there():
    """The radius r - 0.3 r³ + 0.04 r⁵ rises to 0.792 at r² = 2, falls until r² = 2.5, and rises without end then."""
    lens = optics(distortion=(-0.3, 0.04, 0.0, 0.0, 0.0)).lens
    assert lens.field_limit == pytest.approx(2.0, rel=1e-12)
    radius = np.array([0.5, 0.79, 0.8, 1.0, 2.0, 4.0])
    found = lens.directions(lens.centre + lens.focal * np.column_stack([radius, 0 * radius]))
    np.testing.assert_array_equal(np.isnan(found[:, 0]), radius > 0.792)


def _fisheye(*distortion: float) -> FisheyeLens:
    return FisheyeLens(np.array([50.0, 52.0]), np.array([31.7, 24.4]), distortion)


def _directions(angle: np.ndarray, around: np.ndarray | float = 0.0) -> np.ndarray:
    return np.column_stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])


def test_fisheye_is_opencvs():
    lens, local = _fisheye(0.05, -0.02, 0.004, -0.001), _directions(*RNG.uniform(0, [[1.5], [2 * np.pi]], (2, 400)))
    matrix = np.array([[50.0, 0, 31.7], [0, 52.0, 24.4], [0, 0, 1]])
    coefficients = np.array(lens.distortion)
    expected = cv2.fisheye.projectPoints(local[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]
    # At 1.5 rad OpenCV divides by z = 0.07 and takes the arctangent: 14 times the rounding of 100 px.
    np.testing.assert_allclose(lens.project(local), expected, atol=1e-11)
    np.testing.assert_allclose(lens.directions(expected), local, atol=1e-12)


def test_field_ends_where_the_radius_turns_back_or_at_110_degrees():
    lens = _fisheye(-0.25, 0.0, 0.0, 0.0)  # 1 - 0.75 θ² = 0 at θ = 1.1547, radius 2/3 of that
    assert lens.field_limit == pytest.approx(np.sqrt(4 / 3), rel=1e-12)
    edge = 31.7 + 50 * 2 / 3 * lens.field_limit
    found = lens.directions(np.array([[edge - 1e-3, 24.4], [edge + 1e-3, 24.4]]))
    np.testing.assert_array_equal(np.isnan(found[:, 0]), [False, True])
    np.testing.assert_array_equal(np.isnan(lens.project(_directions(np.array([1.15, 1.16])))).all(1), [False, True])
    behind = _directions(np.radians([110.1, 109.9]))
    np.testing.assert_array_equal(np.isnan(_fisheye(0.0, 0.0, 0.0, 0.0).project(behind)).all(1), [True, False])


def test_a_fisheye_lens_sees_behind_itself():
    """Up to 220 degrees from side to side; without coefficients a pixel's distance from the centre is its angle."""
    angle, around = RNG.uniform(0, np.radians(109.9), 400), RNG.uniform(0, 2 * np.pi, 400)
    local = _directions(angle, around)
    plain, bent = _fisheye(0.0, 0.0, 0.0, 0.0), _fisheye(0.05, -0.02, 0.004, -0.0005)
    np.testing.assert_allclose(np.hypot(*((plain.project(local) - (31.7, 24.4)) / (50, 52)).T), angle, atol=1e-13)
    np.testing.assert_allclose(bent.directions(bent.project(local)), local, atol=1e-12)


@pytest.mark.parametrize("index", [1.0, 1.45])
@pytest.mark.parametrize("view", VIEWS)
def test_project_inverts_rays_on_each_path(view, index):
    camera = optics(index=index, **VIEWS[view])
    rays = camera.look(CENTRES)
    assert set(rays.path) - {-1} == set(range(1 + len(VIEWS[view]["mirrors"])))
    seen = rays.path >= 0
    for height in (0.0, 3.9):
        points = rays.origins + rays.directions * ((height - rays.origins[:, 2:]) / rays.directions[:, 2:])
        # Rounding: some 1e-15 relative at 100 px, a few tens of operations.
        np.testing.assert_allclose(camera.project(points[seen], rays.path[seen]), CENTRES[seen], atol=1e-10)
    assert np.isnan(camera.project(np.zeros((2, 3)), -1)).all()


@pytest.mark.parametrize("view", ["sides", "periscope"])
def test_light_is_reflected_at_equal_angles_and_bends_at_the_face(view):
    """From the ray inside the body back through Snell's law to the mirror, and from there to the pinhole."""
    camera = optics(index=1.45, **VIEWS[view])
    rays = camera.look(CENTRES)
    for k, given in enumerate(VIEWS[view]["mirrors"], 1):
        own = rays.path == k
        across = rays.directions[own, :2] * 1.45
        air = np.column_stack([across, -np.sqrt(1 - (across**2).sum(1))])
        normal = np.array(given["normal"]) / np.linalg.norm(given["normal"])
        back = ((np.array(given["position_mm"]) - rays.origins[own]) @ normal) / (-air @ normal)
        place = rays.origins[own] - back[:, None] * air
        assert (back > 0).all()
        assert (place[:, 2] > 9.0).all()  # above the face
        arriving = place - camera.pose.position
        arriving /= np.linalg.norm(arriving, axis=1, keepdims=True)
        np.testing.assert_allclose(arriving @ normal, -air @ normal, atol=1e-12)  # equal angles ...
        tangent = np.eye(3) - np.outer(normal, normal)
        np.testing.assert_allclose(arriving @ tangent, air @ tangent, atol=1e-12)  # ... in one plane


def test_a_mirror_at_45_degrees_in_numbers():
    """Camera at (0, -16, 15) looks along +y; the mirror at y = -2 turns the axis straight down: 14 + 15 mm to z = 0."""
    mirror = {"position_mm": (0.0, -2.0, 15.0), "normal": (0.0, -1.0, -1.0), "size_mm": (30.0, 16.0)}
    camera = optics(mirrors=(mirror,), position_mm=(0.0, -16.0, 15.0), look_at_mm=(0.0, 0.0, 15.0))
    points = np.array([[0.0, -2.0, 0.0], [1.0, -2.0, 0.0], [0.0, -1.0, 0.0]])
    pixels = camera.project(points, 1)
    np.testing.assert_allclose(pixels[0], (31.7, 24.4), atol=1e-12)
    np.testing.assert_allclose(pixels[1] - pixels[0], (70 / 29, 0.0), atol=1e-12)
    # The image's down is the scene's +z before the mirror and, turned by it, +y: away from the camera.
    np.testing.assert_allclose(np.abs(pixels[2] - pixels[0]), (0.0, 71 / 29), atol=1e-12)
    np.testing.assert_allclose(camera.depth(points, 1), 29.0, atol=1e-12)
    np.testing.assert_allclose(camera.project(points), pixels, atol=0)  # by default the path that sees them


def test_a_mirror_ends_at_the_image_of_its_rectangle():
    """Its corners are seen straight in air; OpenCV projects them, and a convex polygon holds the mirror's pixels."""
    camera = optics(index=1.45, mirrors=SIDES, fx=40.0, fy=41.0)
    path = camera.look(CENTRES).path
    for k, mirror in enumerate(camera.mirrors, 1):
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners = mirror.centre + (signs * mirror.half) @ mirror.axes
        image = _by_opencv(camera, corners, 40.0, 41.0, np.zeros(5)).astype(np.float32)
        inside = [cv2.pointPolygonTest(image, (float(x), float(y)), True) for x, y in CENTRES]
        clear = np.abs(inside) > 1e-3  # float32 polygons
        assert clear.sum() > len(CENTRES) - 10
        np.testing.assert_array_equal((path == k)[clear], np.array(inside)[clear] > 0)


def test_points_behind_a_mirror_have_no_image_by_default():
    """Lights are looked for with it: one that a mirror hides stands in no view."""
    upright = {"position_mm": (4.0, 0.0, 12.0), "normal": (-1.0, 0.0, 0.0), "size_mm": (40.0, 4.0)}
    camera = optics(mirrors=(upright,), position_mm=(0.0, 0.0, 20.0), look_at_mm=(0.0, 0.0, 0.0), cx=10.0)
    points = np.array([[9.0, 0.0, 2.0], [2.0, 0.0, 2.0], [-9.0, 0.0, 2.0]])
    straight = camera.project(points, 0)
    assert (straight[:2] > 0).all()  # 10 + 70 * 9 / 18 = 45 px, where the mirror is
    assert (straight[:2] < WIDTH).all()
    seen = camera.project(points)
    assert np.isnan(seen[0]).all()
    np.testing.assert_array_equal(seen[1:], straight[1:])  # the last is outside the image: where it would be


def test_backs_second_reflections_and_what_is_beyond_the_field_show_nothing():
    turned = {**SIDES[0], "normal": (1.0, 0.0, 0.25), "rotation_deg": -4.0}
    plain, back = (optics(index=1.45, mirrors=(m,), fx=40.0, fy=41.0).look(CENTRES) for m in (SIDES[0], turned))
    np.testing.assert_array_equal(back.path, np.where(plain.path == 1, -1, plain.path))
    assert np.isnan(back.directions[plain.path == 1]).all()
    # A strip that lies 1.2 mm above the face, where light comes down from the first mirror.
    facing = {"position_mm": (4.6, -0.5, 10.2), "normal": (0.0, 0.0, 1.0), "size_mm": (0.5, 30.0)}
    both = optics(index=1.45, mirrors=(SIDES[0], facing), fx=40.0, fy=41.0).look(CENTRES)
    lost = (plain.path == 1) & (both.path == -1)
    assert lost.sum() > 20
    # It would have met the face below the strip, half of 0.5 mm and 1.2 mm times a slope of up to 0.4 to either side.
    assert np.abs(plain.origins[lost, 0] - 4.6).max() < 0.25 + 1.2 * 0.4
    assert set(both.path[plain.path == 0]) == {0, -1}  # seen straight, the strip mirrors the dark above it
    path = optics(index=1.45, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0), fx=30.0, fy=30.0).look(CENTRES).path
    assert set(path) == {0, -1}  # without mirrors: -1 beyond the lens's field


@pytest.mark.parametrize(("changes", "words"), [
    ({"mirrors": ({**SIDES[0], "normal": (0, 0, 0)},)}, "normal is zero"),
    ({"mirrors": ({**SIDES[0], "position_mm": (6.0, 0.0, 12.0)},)}, "reaches down to z"),
    ({"look_at_mm": (0.0, 0.0, 30.0)}, "only a mirror could turn its view back"),
    ({"lens": "fisheye"}, "needs distortion = \\[k1, k2, k3, k4\\]"),
    ({"distortion": (0.1, 0.0)}, "distortion has 2 numbers; a pinhole lens needs"),
])  # fmt: skip
def test_impossible_optics_are_named(changes, words):
    with pytest.raises(ValueError, match=words):
        sensor(index=1.45, **changes)
