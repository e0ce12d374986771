"""Round gels seen from within: windows by Snell's law and Fermat's principle, patterns about the axis, rendering."""

import numpy as np
import pytest
from commands import refused
from pydantic import ValidationError
from render_scenes import FAST, SCALAR, needs_llvm
from round_gels import ASKEW, CAPSULE, CYLINDER, INNER, INSIDE, LENGTH, RADIUS, SPHERE, capsule, dented, on_face, sensor
from scipy.ndimage import map_coordinates
from scipy.optimize import brentq, least_squares
from verified_sample import motion_checks, sheets

from synth.flow.exact import exact_flow
from synth.flow.trace import trace
from synth.flow.view import View
from synth.optics import Optics
from synth.optics.window import RoundWindow, _far_root
from synth.render.chart import RoundChart, chart_of
from synth.render.gel_mesh import GelMesh
from synth.render.marks import marks_coverage
from synth.render.pattern import albedo, pixels_per_mm
from synth.render.renderer import Renderer
from synth.scene import Dots, Light, Render, Speckle
from synth.verify import motion
from synth.verify.camera import ForwardCamera
from synth.verify.motion import check_motion, derive
from synth.verify.shell import Shell

RNG = np.random.default_rng(11)
SURFACE = capsule(3.4)
PLACE = on_face(np.array([[8.0, 3.0, 6.0]]))[0]
SHAPES = {
    "sphere": RoundWindow(1.45, INNER, RADIUS, RADIUS),
    "capsule": RoundWindow(1.45, INNER, RADIUS, np.inf),
    "cylinder": RoundWindow(1.45, INNER, -np.inf, np.inf),
    "dense": RoundWindow(2.5, INNER, RADIUS, np.inf),
}
EYES = np.array([(0.0, 0.0, 13.0), (2.5, -3.0, 14.0), (0.0, 8.7, 12.5)])
CHART = RoundChart(RADIUS, RADIUS + LENGTH)
DOTS = Dots(kind="dots", spacing_mm=(4.2, 3.0), radius_mm=0.35, softness_mm=0.0, placing="spherical")
FACE = capsule(2.7)


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


def test_a_root_near_zero_keeps_its_digits():
    """Of t² + 2 half t - c with a small c: c / (2 half) before the face, and -2 half - c / (2 half) behind it."""
    roots = _far_root(np.ones(2), np.array([0.5, -0.5]), np.array([-1e-20, -1e-20]))
    np.testing.assert_allclose(roots, [1e-20, 1.0], rtol=1e-15)


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
    first = dented(SURFACE.material, PLACE, 1.0)
    second = dented(first, PLACE, 0.8, (0.6, -1.0, 0.8))
    flow, checks = motion_checks(seen, SURFACE, first, second)
    assert all(check.passed for check in checks.values()), checks
    assert max(checks[f"{way} flow"].figure for way in ("forward", "backward")) < 1e-4
    assert 0.5 < np.nanmax(np.abs(flow.forward)) < 10
    rays = Optics.of(seen).look(Optics.of(seen).centres)
    assert (rays.directions[np.isfinite(flow.forward[..., 0]).ravel(), 2] > 0.05).any()


def test_verification_finds_another_index_and_another_radius():
    right = sensor(CAPSULE, **ASKEW)
    states = SURFACE.material, dented(SURFACE.material, PLACE, 1.0)
    flow = exact_flow(View(SURFACE, Optics.of(right)), *states, backward=False)
    for wrong in (sensor(CAPSULE, 1.44, **ASKEW), sensor({**CAPSULE, "radius_mm": INNER + 0.1}, **ASKEW)):
        near, far = sheets(wrong, SURFACE, *states)
        checks = check_motion("forward", near, far, flow.forward, flow.forward_visible)
        assert not all(check.passed for check in checks)


@pytest.mark.parametrize("window", [SPHERE, CAPSULE, CYLINDER], ids=lambda window: window["shape"])
def test_verification_shoots_few_rays_for_each_point(window, monkeypatch):
    """A finite-difference Jacobian in every step took 21 to 25 rays. The tip and the place above it lie on the axis."""
    eye, shots, turned = np.array(INSIDE["position_mm"]), [], Shell._turned
    monkeypatch.setattr(
        Shell, "_turned", lambda self, rays, *rest: shots.append(rays.size / 3) or turned(self, rays, *rest)
    )
    points = FACE.material[FACE.material[:, 2] > 8] if window is CYLINDER else np.vstack([FACE.material, np.zeros(3)])
    shell = Shell.of(sensor(window).window)
    found = shell.crossings(points, eye, 1.45)
    assert sum(shots) < 11 * len(points)
    low, high = (-np.inf, np.inf) if window is CYLINDER else (RADIUS, RADIUS if window is SPHERE else np.inf)
    expected, converged = RoundWindow(1.45, INNER, low, high).crossings(points, eye)
    assert converged.all()
    # A miss of 1e-12 of up to 20 mm, times up to 10 where the ray meets the face at a slant.
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_verification_in_tiles_is_that_of_the_whole(monkeypatch):
    states = SURFACE.material, dented(SURFACE.material, PLACE, 1.0, (0.6, -1.0, 0.8))
    pair = sheets(sensor(CAPSULE, **ASKEW), SURFACE, *states)
    places = np.random.default_rng(2).uniform(0, 64, (500, 2))
    whole = derive(*pair, places, np.zeros((500, 2)))
    monkeypatch.setattr(motion, "_TILE", 7)
    tiled = derive(*pair, places, np.zeros((500, 2)))
    for one, other in zip(vars(whole).values(), vars(tiled).values(), strict=True):
        # Root searches stop at a miss of 1e-8 px; how many steps a place takes may depend on those beside it.
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_a_matched_window_bends_nothing_and_a_centred_eye_looks_straight():
    points = on_face(_directions(200) * 5 + (0, 0, RADIUS))
    matched = Optics.of(sensor(CAPSULE, 1.0, **ASKEW)).project(points)
    thin = Optics.of(sensor(CAPSULE, 1 + 1e-12, **ASKEW)).project(points)
    np.testing.assert_allclose(thin, matched, atol=1e-9)
    centred = {"position_mm": (0.0, 0.0, RADIUS)}
    bent, straight = (Optics.of(sensor(SPHERE, index, **centred)).project(points) for index in (1.45, 1.0))
    np.testing.assert_allclose(bent, straight, atol=1e-11)  # every ray from the centre is a normal


def test_a_cylinder_is_open_at_its_ends_and_what_is_in_air_is_seen_straight():
    band = on_face(np.column_stack([_directions(300)[:, :2] * 20, RNG.uniform(12, 20, 300)]))
    seen = sensor(CYLINDER, **INSIDE)
    forward, own = ForwardCamera.of(seen).see(band), Optics.of(seen).project(band)
    np.testing.assert_allclose(own, forward, atol=1e-9)
    eye = np.array(INSIDE["position_mm"])
    origins, onward = SHAPES["cylinder"].enter(eye, np.array([[0.0, 0.0, -1.0], [0.0, 0.6, -0.8]]))
    np.testing.assert_array_equal(np.isnan(np.hstack([origins, onward])).all(axis=1), [True, False])
    inside = np.array([[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(SHAPES["cylinder"].aim(inside, eye), inside - eye)


@pytest.mark.parametrize(("window", "camera", "words"), [
    ({"shape": "sphere", "radius_mm": 9.0}, {}, "center_z_mm"),
    ({"radius_mm": 9.0}, {}, "radius_mm"),
    (CAPSULE, {"position_mm": (0.0, 0.0, 2.5)}, "must lie inside the window's capsule"),
    (SPHERE, {"lens": "pinhole", "distortion": (0.0,) * 5, "aperture_mm": 1.0, "focus_mm": 9.0}, "only a pinhole"),
])  # fmt: skip
def test_what_does_not_fit_a_round_window_is_named(window, camera, words):
    with pytest.raises(ValueError, match=words):
        sensor(window, **camera)


def _texels(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres along one axis, and of all texels the area of the face, mm²."""
    x = ((np.arange(count) + 0.5) / count - 0.5) * CHART.size_mm[0]
    arc = np.hypot(*np.meshgrid(x, x))
    return x, np.where(arc < CHART.end, CHART.across(arc) / arc * (x[1] - x[0]) ** 2, 0)


def test_the_chart_keeps_arcs_and_azimuths() -> None:
    points = on_face(np.random.default_rng(2).normal(size=(300, 3)) * 8 + (0, 0, 14))
    places = CHART.flattened(points)
    np.testing.assert_allclose(CHART.points(np.hypot(*places.T), np.arctan2(*places.T[::-1])), points, atol=1e-12)
    assert CHART.end == pytest.approx(RADIUS * np.pi / 2 + LENGTH)
    np.testing.assert_array_equal(CHART.flattened(np.zeros((1, 3))), [[0, 0]])  # the tip


@pytest.mark.parametrize(("placing", "meridians"), [("spherical", 18), ("cylindrical", 18), ("spherical", 17)])
def test_dots_have_their_size_and_places_on_the_face(placing: str, meridians: int) -> None:
    x, area = _texels(1500)
    spaced = DOTS.model_copy(update={"placing": placing, "spacing_mm": (75.6 / meridians, 3.0)})
    coverage = marks_coverage(spaced, CHART, x, x, np.random.default_rng(0))
    assert coverage[749:751, 749:751].min() == 1  # one at the tip
    angle, arc = np.arctan2(*np.meshgrid(x, x)[::-1]), np.hypot(*np.meshgrid(x, x))
    for height in (3.0, 9.0, 15.0):
        middle = height if placing == "spherical" else float(CHART.arc(np.array(height)))
        ring = (np.abs(arc - middle) < 0.6) * coverage
        # round(2 pi 12 / 4.2) = 18 discs of 0.35 mm, at 3 mm half of them; the cap has 1e-4 more, texels err by 1 %.
        count = meridians // 2 if middle == 3.0 else meridians
        assert (ring * area).sum() == pytest.approx(count * np.pi * 0.35**2, rel=0.02)
        turned = np.exp(1j * count * angle)  # 1 at each dot, if all gaps are alike
        assert abs(np.average(turned, weights=ring * area)) > np.cos(count * 0.35 / float(CHART.across(middle)))


def test_speckle_has_its_coverage_and_grain_size_all_over_the_face() -> None:
    x, area = _texels(1200)
    pattern = Speckle(kind="speckle", grain_mm=1.0, coverage=0.4, placing="spherical")
    rng = np.random.default_rng(5)
    coverage = np.mean([(marks_coverage(pattern, CHART, x, x, rng) * area).sum() / area.sum() for _ in range(3)])
    assert coverage == pytest.approx(0.4, abs=0.01)
    dark = marks_coverage(pattern.model_copy(update={"coverage": 0.5}), CHART, x, x, rng)

    def at(arc: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        place = np.stack([arc * np.sin(azimuth), arc * np.cos(azimuth)]) / CHART.size_mm[0] * 1200 + 599.5
        return map_coordinates(dark, place, order=1) > 0.5

    for arc in (6.0, 15.0, 24.0):  # chords along circles: Rice's formula, 1.11 mm
        rings = arc + np.array([-1.5, -0.5, 0.5, 1.5])
        azimuth = np.linspace(-np.pi, np.pi, 8000)
        crossings = sum(np.count_nonzero(np.diff(at(np.full(8000, ring), azimuth).astype(int))) for ring in rings)
        chord = 2 * np.pi * sum(float(CHART.across(np.array(ring))) for ring in rings) / crossings
        # Some 140 to 270 chords whose lengths scatter by half of themselves: 4 %; three times that.
        assert chord == pytest.approx(1.11, rel=0.13)


@needs_llvm
def test_pictures_show_the_texture_where_the_optics_say() -> None:
    """Light without a texture divides out: the rest is the texture at the point that each pixel's own ray meets."""
    light = Light(position_mm=(5.0, -7.0, 17.0), aim_mm=(0.0, 0.0, 4.0), size_mm=(1.0, 1.0), color=(1, 1, 1), power=99)
    seen = sensor(CAPSULE, lights=(light,), **ASKEW).model_copy(update={"pattern": DOTS})
    chart, optics = chart_of(seen), Optics.of(seen)
    assert chart == CHART
    row, column = np.mgrid[:512, :512] / 511
    texture = np.stack([0.2 + 0.6 * column, 0.2 + 0.6 * row, np.full((512, 512), 0.5)], axis=-1).astype(np.float32)
    render = Render(samples_per_pixel=16, max_depth=2, light="separated")
    image = Renderer(seen, render, FACE, texture, FAST).radiance(FACE.material, 0)
    rays = optics.look(optics.centres)
    hits = trace(FACE.material, FACE.triangles, rays.origins, rays.directions)
    places = GelMesh(FACE, chart).texture_coordinates().reshape(-1, 2)
    expected = 0.2 + 0.6 * hits.interpolate(FACE.triangles, places.astype(np.float64))
    red, green, blue = image.reshape(-1, 3).T
    lit = (blue > 0.05 * blue.max()) & (hits.triangle >= 0)
    assert lit.sum() > 2000
    for channel, value in ((red, expected[:, 0]), (green, expected[:, 1])):
        off = 0.5 * channel[lit] / blue[lit] - value[lit]
        # A pixel is 0.2 to 0.9 mm wide, 0.6 / 54 of the texture a mm; stratified samples miss its centre by a tenth.
        assert np.abs(off).mean() < 0.2 * 0.9 * 0.6 / 54
        assert abs(off.mean()) < 1e-4


def test_textures_are_fine_enough_for_the_nearest_part_of_the_face() -> None:
    seen = sensor(CAPSULE, **ASKEW).model_copy(update={"pattern": DOTS})
    texture = albedo(seen, np.random.default_rng(0))
    assert texture.shape[0] / CHART.size_mm[0] == pytest.approx(4 * pixels_per_mm(seen), rel=0.01)
    with pytest.raises(ValidationError, match="cannot be turned"):
        Dots(kind="dots", spacing_mm=(2, 2), radius_mm=0.3, placing="spherical", rotation_deg=3.0)


def test_scalar_variants_refuse_round_windows() -> None:
    seen = sensor(CAPSULE, lens="pinhole", distortion=(0.0,) * 5, fx=60.0, fy=60.0)
    given = (Render(samples_per_pixel=1), FACE, np.full((4, 4, 3), 0.5, np.float32), SCALAR)
    refused(r"sensor\.window\.shape = 'capsule' needs LLVM", Renderer, seen, *given)
