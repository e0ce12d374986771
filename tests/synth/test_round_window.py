"""Round windows seen from within: against Snell's law in angles, Fermat's principle, and verification's own camera."""

import numpy as np
import pytest
from round_gels import ASKEW, CAPSULE, CYLINDER, INNER, INSIDE, RADIUS, SPHERE, capsule, on_capsule, pressed, sensor
from scipy.optimize import brentq, least_squares
from verified_sample import motion_checks, sheets

from synth.flow.exact import exact_flow
from synth.flow.view import View
from synth.optics import Optics
from synth.optics.round_window import RoundWindow
from synth.verify.camera import ForwardCamera
from synth.verify.motion import check_motion

RNG = np.random.default_rng(11)
SURFACE = capsule(3.4)
PLACE = on_capsule(np.array([[8.0, 3.0, 6.0]]))[0]
SHAPES = {
    "sphere": RoundWindow(1.45, INNER, RADIUS, RADIUS),
    "capsule": RoundWindow(1.45, INNER, RADIUS, np.inf),
    "cylinder": RoundWindow(1.45, INNER, -np.inf, np.inf),
    "dense": RoundWindow(2.5, INNER, RADIUS, np.inf),
}
EYES = np.array([(0.0, 0.0, 13.0), (2.5, -3.0, 14.0), (0.0, 8.7, 12.5)])


def _directions(n: int) -> np.ndarray:
    directions = RNG.normal(size=(n, 3))
    directions[:, 2] = np.where(directions[:, 2] > 1, -directions[:, 2], directions[:, 2])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("eye", EYES, ids=["axis", "beside", "near the face"])
@pytest.mark.parametrize("window", SHAPES.values(), ids=SHAPES)
def test_aim_inverts_enter_and_converges(window, eye):
    air = _directions(4000)
    origins, onward = window.enter(eye, air)
    np.testing.assert_allclose(np.linalg.norm(onward, axis=1), 1, atol=1e-14)
    for reach in (1e-4, 0.5, 3.0, 50.0):
        points = origins + reach * onward
        crossings, converged = window.crossings(points, eye)
        assert converged.all()
        aim = window.aim(points, eye)
        # The nearest eye is 0.3 mm from the face: rounding of 20 mm (4e-15) against that, a few tens of operations.
        np.testing.assert_allclose(aim / np.linalg.norm(aim, axis=1, keepdims=True), air, atol=1e-12)
        np.testing.assert_allclose(crossings, origins, atol=1e-12)


def test_rays_are_bent_by_snells_law_in_the_plane_of_eye_centre_and_point():
    """A sphere in its plane: angles at the centre, the sine law, and a root by Brent's method."""
    eye, points = EYES[1], RADIUS * 1.2 * _directions(60) + (0, 0, RADIUS)
    found, converged = SHAPES["sphere"].crossings(points, eye)
    assert converged.all()
    offset = eye - (0, 0, RADIUS)
    away = np.linalg.norm(offset)
    for point, crossing in zip(points, found, strict=True):
        arm = point - (0, 0, RADIUS)
        between, out = np.arccos(arm @ offset / away / np.linalg.norm(arm)), np.linalg.norm(arm)

        def beyond(polar: float, between: float = between, out: float = out) -> float:
            """N sin θ' - sin θ for light that crosses at this angle at the centre from the eye."""
            inner = np.hypot(INNER * np.sin(polar), INNER * np.cos(polar) - away)
            outer = np.hypot(out * np.sin(between - polar), out * np.cos(between - polar) - INNER)
            return 1.45 * out * np.sin(between - polar) / outer - away * np.sin(polar) / inner

        polar = np.arccos((crossing - (0, 0, RADIUS)) @ offset / away / INNER)
        assert polar == pytest.approx(brentq(beyond, 0, between, xtol=1e-15), abs=1e-9)  # arccos loses half the digits


def test_crossings_of_a_capsule_take_the_shortest_optical_length():
    """By least squares of its slopes, for azimuth and arc along the meridian, from elsewhere on the face."""
    eye, end = EYES[1], INNER * np.pi / 2

    def place(azimuth: float, arc: float) -> np.ndarray:
        angle = min(arc / INNER, np.pi / 2)
        out, z = INNER * np.sin(angle), RADIUS - INNER * np.cos(angle) + max(arc - end, 0)
        return np.array([out * np.cos(azimuth), out * np.sin(azimuth), z])

    points = np.array([(9.0, 5.0, 6.0), (-10.5, 2.0, 13.0), (-1.0, 11.0, 18.0), (0.5, -0.4, 0.3), (8.0, -8.0, 11.5)])
    for point, crossing in zip(points, SHAPES["capsule"].crossings(points, eye)[0], strict=True):

        def slopes(at: np.ndarray, point: np.ndarray = point) -> list[float]:
            here = place(*at)
            net = (here - eye) / np.linalg.norm(here - eye) - 1.45 * (point - here) / np.linalg.norm(point - here)
            return [net @ (place(*(at + step)) - place(*(at - step))) / 2e-6 for step in 1e-6 * np.eye(2)]

        foot = point - (0, 0, max(point[2], RADIUS))
        start = [np.arctan2(point[1], point[0]), INNER * np.arctan2(np.hypot(*foot[:2]), -foot[2])]
        start[1] += max(point[2] - RADIUS, 0)
        result = least_squares(slopes, start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(place(*result.x), crossing, atol=1e-8)  # differences of 1e-6 leave 1e-10 of a slope


@pytest.mark.parametrize(("window", "view"), [(SPHERE, INSIDE), (CAPSULE, ASKEW)], ids=["sphere", "capsule"])
def test_flow_and_visibility_through_round_windows_against_verification(window, view):
    """Every pixel both ways, some with rays that go up; the field ends in the image, and so does the gel."""
    seen = sensor(window, **view)
    first = pressed(SURFACE.material, PLACE, 1.0)
    second = pressed(first, PLACE, 0.8, (0.6, -1.0, 0.8))
    flow, checks = motion_checks(seen, SURFACE, first, second)
    assert all(check.passed for check in checks.values()), checks
    assert max(checks[f"{way} flow"].figure for way in ("forward", "backward")) < 1e-4
    assert 0.5 < np.nanmax(np.abs(flow.forward)) < 10
    rays = Optics.of(seen).look(Optics.of(seen).centres)
    assert (rays.directions[np.isfinite(flow.forward[..., 0]).ravel(), 2] > 0.05).any()


def test_verification_finds_another_index_and_another_radius():
    right = sensor(CAPSULE, **ASKEW)
    states = SURFACE.material, pressed(SURFACE.material, PLACE, 1.0)
    flow = exact_flow(View(SURFACE, Optics.of(right)), *states, backward=False)
    for wrong in (sensor(CAPSULE, 1.44, **ASKEW), sensor({**CAPSULE, "radius_mm": INNER + 0.1}, **ASKEW)):
        near, far = sheets(wrong, SURFACE, *states)
        checks = check_motion("forward", near, far, flow.forward, flow.forward_visible)
        assert not all(check.passed for check in checks)


def test_a_matched_window_bends_nothing_and_a_centred_eye_looks_straight():
    points = on_capsule(_directions(200) * 5 + (0, 0, RADIUS))
    matched = Optics.of(sensor(CAPSULE, 1.0, **ASKEW)).project(points)
    thin = Optics.of(sensor(CAPSULE, 1 + 1e-12, **ASKEW)).project(points)
    np.testing.assert_allclose(thin, matched, atol=1e-9)
    centred = {"position_mm": (0.0, 0.0, RADIUS)}
    bent, straight = (Optics.of(sensor(SPHERE, index, **centred)).project(points) for index in (1.45, 1.0))
    np.testing.assert_allclose(bent, straight, atol=1e-11)  # every ray from the centre is a normal


def test_a_cylinder_is_open_at_its_ends_and_what_is_in_air_is_seen_straight():
    band = on_capsule(np.column_stack([_directions(300)[:, :2] * 20, RNG.uniform(12, 20, 300)]))
    seen = sensor(CYLINDER, **INSIDE)
    forward, own = ForwardCamera.of(seen).see(band), Optics.of(seen).project(band)
    np.testing.assert_allclose(own, forward, atol=1e-9)
    eye = np.array(INSIDE["position_mm"])
    origins, onward = SHAPES["cylinder"].enter(eye, np.array([[0.0, 0.0, -1.0], [0.0, 0.6, -0.8]]))
    np.testing.assert_array_equal(np.isnan(np.hstack([origins, onward])).all(axis=1), [True, False])
    inside = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(SHAPES["cylinder"].aim(inside, eye), inside - eye)


@pytest.mark.parametrize(
    ("window", "camera", "words"),
    [
        ({"shape": "sphere", "radius_mm": 9.0}, {}, "needs center_z_mm"),
        ({"radius_mm": 9.0}, {}, "has no radius_mm"),
        (CAPSULE, {"position_mm": (0.0, 0.0, 2.5)}, "must lie inside the window's capsule"),
        (SPHERE, {"lens": "pinhole", "distortion": (0.0,) * 5, "aperture_mm": 1.0, "focus_mm": 9.0}, "only a pinhole"),
    ],
)
def test_what_does_not_fit_a_round_window_is_named(window, camera, words):
    with pytest.raises(ValueError, match=words):
        sensor(window, **camera)
