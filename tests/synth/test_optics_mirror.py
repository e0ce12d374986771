"""Views by flat mirrors: the law of reflection, where a mirror ends, and what stands in the way."""

import cv2
import numpy as np
import pytest
from kinematic_double import FISHEYE, HEIGHT, LENS, LEVEL, PERISCOPE, SIDES, WIDTH, optics, pixel_centres, sensor

CENTRES = pixel_centres().reshape(-1, 2)
VIEWS = {
    "sides": {"mirrors": SIDES, "distortion": LENS, "fx": 40.0, "fy": 41.0},
    "periscope": {"mirrors": PERISCOPE, **LEVEL},
    "fisheye": {"mirrors": SIDES, **FISHEYE, "fx": 35.0, "fy": 35.0},
}
PATHS = {"sides": {0, 1, 2}, "periscope": {0, 1}, "fisheye": {0, 1, 2}}


@pytest.mark.parametrize("index", [1.0, 1.45])
@pytest.mark.parametrize("view", VIEWS)
def test_project_inverts_rays_on_each_path(view, index):
    camera = optics(index=index, **VIEWS[view])
    rays = camera.look(CENTRES)
    assert set(rays.path) - {-1} == PATHS[view]
    seen = rays.path >= 0
    for height in (0.0, 3.9):
        points = rays.origins + rays.directions * ((height - rays.origins[:, 2:]) / rays.directions[:, 2:])
        # Rounding: some 1e-15 relative at 100 px, a few tens of operations.
        np.testing.assert_allclose(camera.project(points[seen], rays.path[seen]), CENTRES[seen], atol=1e-10)
    assert np.isnan(camera.project(np.zeros((2, 3)), -1)).all()


@pytest.mark.parametrize("view", ["sides", "periscope"])
def test_light_is_reflected_at_equal_angles_and_bends_at_the_face(view):
    """From the ray inside the body back through Snell's law to the mirror, and from there to the pinhole.

    Fails with the factor 2 of `FlatMirror.turned` changed to 1.99.
    """
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
    matrix = np.array([[40.0, 0, 31.7], [0, 41.0, 24.4], [0, 0, 1]])
    handed = np.array([1.0, 1.0, -1.0])  # OpenCV's world is right-handed
    axes = np.array([camera.pose.right, camera.pose.down, camera.pose.forward]) * handed
    shift = -axes @ (camera.pose.position * handed)
    for k, mirror in enumerate(camera.mirrors, 1):
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners = (mirror.centre + (signs * mirror.half) @ mirror.axes) * handed
        image = cv2.projectPoints(corners, cv2.Rodrigues(axes)[0], shift, matrix, np.zeros(5))[0].astype(np.float32)
        inside = [cv2.pointPolygonTest(image, (float(x), float(y)), True) for x, y in CENTRES]
        clear = np.abs(inside) > 1e-3  # float32 polygons
        assert clear.sum() > WIDTH * HEIGHT - 10
        np.testing.assert_array_equal((path == k)[clear], np.array(inside)[clear] > 0)


def test_points_behind_a_mirror_have_no_image_by_default():
    """Lights are looked for with it: one that a mirror hides stands in no view.

    Fails with the last condition of `Optics.project` left out.
    """
    upright = {"position_mm": (4.0, 0.0, 12.0), "normal": (-1.0, 0.0, 0.0), "size_mm": (40.0, 4.0)}
    camera = optics(mirrors=(upright,), position_mm=(0.0, 0.0, 20.0), look_at_mm=(0.0, 0.0, 0.0), cx=10.0)
    points = np.array([[9.0, 0.0, 2.0], [2.0, 0.0, 2.0], [-9.0, 0.0, 2.0]])
    straight = camera.project(points, 0)
    assert (straight[:2] > 0).all()  # 10 + 70 * 9 / 18 = 45 px, where the mirror is
    assert (straight[:2] < WIDTH).all()
    seen = camera.project(points)
    assert np.isnan(seen[0]).all()
    np.testing.assert_array_equal(seen[1], straight[1])
    np.testing.assert_array_equal(seen[2], straight[2])  # outside the image: where it would be


def test_backs_and_second_reflections_show_nothing():
    """Fails with backs let through in `first_met`, and with its second loop left out."""
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


def test_a_camera_without_mirrors_has_one_path():
    path = optics(index=1.45, distortion=(-0.3, 0.0, 0.0, 0.0, 0.0), fx=30.0, fy=30.0).look(CENTRES).path
    assert set(path) == {0, -1}  # -1 beyond the lens's field


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mirrors": ({**SIDES[0], "normal": (0, 0, 0)},)}, "normal is zero"),
        ({"mirrors": ({**SIDES[0], "position_mm": (6.0, 0.0, 12.0)},)}, "reaches down to z"),
        ({"look_at_mm": (0.0, 0.0, 30.0)}, "only a mirror could turn its view back"),
        ({"lens": "fisheye"}, "needs distortion = \\[k1, k2, k3, k4\\]"),
        ({"distortion": (0.1, 0.0)}, "distortion has 2 numbers; a pinhole lens needs"),
    ],
)
def test_impossible_optics_are_named(changes, words):
    with pytest.raises(ValueError, match=words):
        sensor(index=1.45, **changes)
