"""Simpler methods of making flow, on flat gels whose flow has a closed form and on a bump that hides a part."""

from dataclasses import replace

import numpy as np
import pytest
from render_scenes import flat_surface, plain, small_sensor

from benchmarks.flow import derived, method_row
from benchmarks.flow_methods import METHODS, SHIPPED, fitted_pinhole, is_inside
from benchmarks.pressed_gel import View, main_camera
from benchmarks.rows import Row
from synth.render.camera_image import expected_signal

FOCAL = 160.0
"""px, so that the gel's edges stay out of the image."""


def moved(index: float, motion: tuple[float, float, float], cells: int = 12) -> View:
    """A flat gel that moves as a whole, mm; no refraction at index 1."""
    sensor = small_sensor(index, fx=FOCAL, fy=FOCAL)
    surface = flat_surface(sensor, cells)
    return View(sensor, plain(), surface, surface.material + np.array(motion))


def measured(view: View) -> dict[str, Row]:
    """A row of every method."""
    truth = derived(view)
    return {method: method_row(view, truth, method) for method in METHODS}


def test_every_method_is_right_where_it_leaves_out_nothing() -> None:
    """Without refraction, for motion along a flat face, flow is f t / Z everywhere and each simplification is exact."""
    view = moved(1.0, (0.47, -0.32, 0.0))  # its ends lie off the border
    expected = FOCAL * np.array([0.47, -0.32]) / 20.0
    # float64; the root search ends at 1e-6 of a triangle's weights at worst, here of 0.5 mm and 8 px/mm.
    np.testing.assert_allclose(derived(view)[0][0], np.broadcast_to(expected, (60, 80, 2)), atol=4e-6)
    for name, row in measured(view).items():
        assert row["max_px"] < 5e-6, name  # float32 flow of 4 px: 2.4e-7
        assert row["mask_px"] == 0, name


def test_what_a_camera_without_perspective_misses() -> None:
    """A gel that rises by 0.5 mm: no motion in x and y, so that the affine camera misses all of it."""
    view = moved(1.0, (0.0, 0.0, 0.5))
    truth = derived(view)
    row = method_row(view, truth, "affine camera, fitted")
    assert row["max_px"] == pytest.approx(max(np.linalg.norm(flow, axis=2).max() for flow, _ in truth), rel=1e-6)
    # f r / (Z - 0.5) - f r / Z at the corner pixel farthest from the axis, (42, 28) px; backward it is smaller.
    assert row["max_px"] == pytest.approx(np.hypot(42, 31) * (20 / 19.5 - 1), rel=0.03)


def test_the_fitted_pinhole_is_the_paraxial_one() -> None:
    """Apparent depth: 14 mm of air and 6 mm of gel at n = 1.45 look like 14 + 6 / 1.45. Off the axis the last term, 23
    % of the depth, differs by (1 - 1 / n²) tan² / 2: 0.7 % of the depth at the corners, less in the mean.
    """
    camera = fitted_pinhole(moved(1.45, (0, 0, 0))).camera
    assert camera.fx / FOCAL == pytest.approx(20 / (14 + 6 / 1.45), rel=0.007)
    assert camera.fy / camera.fx == pytest.approx(1, rel=1e-12)


def test_refraction_left_out() -> None:
    """Seen straight from above a translation is scaled by the ratio of the apparent depths."""
    found = measured(moved(1.45, (0.5, 0.0, 0.0)))
    lost = 0.5 * FOCAL * (1 / (14 + 6 / 1.45) - 1 / 20)
    # The depth differs by 0.25 % in the mean (as above), its derivative by up to three times that: 0.033 of 4.4 px.
    assert found["no refraction"]["mean_px"] == pytest.approx(lost, abs=0.033)
    assert found["no refraction, focal length fitted"]["mean_px"] < 0.1 * lost
    assert found["vertices of the rendered surface, interpolated"]["mean_px"] < 0.01 * lost


def test_occlusion() -> None:
    """A bump near the side of the image, so steep that it hides what lies behind it."""
    flat = moved(1.0, (0.0, 0.0, 0.0), 48)
    pressed = flat.pressed.copy()
    pressed[:, 2] += 2.5 * np.exp(-((pressed[:, 0] - 4.0) ** 2 + pressed[:, 1] ** 2) / 0.35**2)
    view = replace(flat, pressed=pressed)
    hidden = sum(int(np.count_nonzero(is_inside(flow) & ~visible)) for flow, visible in derived(view))
    found = measured(view)
    assert hidden > 5
    assert found[SHIPPED]["mask_px"] == found["every pixel tested for occlusion"]["mask_px"] == 0
    assert found["no test for occlusion"]["mask_px"] == hidden


def test_another_size_keeps_what_the_camera_sees() -> None:
    """The mean signal stays: the same field of view, exposure and vignetting."""
    sensor = small_sensor(1.45, vignetting=0.5)
    small = main_camera(sensor, 0.5)
    signals = [expected_signal(np.ones((c.height, c.width, 3), np.float32), c) for c in (sensor.camera, small.camera)]
    # The vignette is quadratic; its mean over pixels of twice the width differs by (1/80)² / 4 of 1/2 at most.
    assert signals[0].mean() == pytest.approx(signals[1].mean(), abs=1e-4)
    assert small.camera.fx / small.camera.width == sensor.camera.fx / sensor.camera.width
