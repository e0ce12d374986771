"""Patterns about the axis of a round gel, and rendering through round windows."""

import numpy as np
import pytest
from commands import refused
from pydantic import ValidationError
from render_scenes import FAST, SCALAR, needs_llvm
from round_gels import ASKEW, CAPSULE, LENGTH, RADIUS, capsule, on_capsule, sensor
from scipy.ndimage import map_coordinates

from synth.flow.trace import trace
from synth.optics import Optics
from synth.render.chart import RoundChart, chart_of
from synth.render.gel_mesh import GelMesh
from synth.render.pattern import albedo, pixels_per_mm
from synth.render.renderer import Renderer
from synth.render.round_marks import round_dots, round_speckle
from synth.scene import Dots, Light, Render, Speckle

CHART = RoundChart(RADIUS, RADIUS + LENGTH)
DOTS = Dots(kind="dots", spacing_mm=(4.2, 3.0), radius_mm=0.35, softness_mm=0.0, placing="spherical")
SURFACE = capsule(2.7)


def _texels(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres along one axis, and of all texels the area of the face, mm²."""
    x = ((np.arange(count) + 0.5) / count - 0.5) * CHART.size_mm[0]
    arc = np.hypot(*np.meshgrid(x, x))
    return x, np.where(arc < CHART.end, CHART.across(arc) / arc * (x[1] - x[0]) ** 2, 0)


def test_the_chart_keeps_arcs_and_azimuths() -> None:
    points = on_capsule(np.random.default_rng(2).normal(size=(300, 3)) * 8 + (0, 0, 14))
    places = CHART.flattened(points)
    np.testing.assert_allclose(CHART.points(np.hypot(*places.T), np.arctan2(*places.T[::-1])), points, atol=1e-12)
    assert CHART.end == pytest.approx(RADIUS * np.pi / 2 + LENGTH)
    np.testing.assert_array_equal(CHART.flattened(np.zeros((1, 3))), [[0, 0]])  # the tip


@pytest.mark.parametrize("placing", ["spherical", "cylindrical"])
def test_dots_have_their_size_and_places_on_the_face(placing: str) -> None:
    x, area = _texels(1500)
    coverage = round_dots(DOTS.model_copy(update={"placing": placing}), CHART, x, x, np.random.default_rng(0))
    assert coverage[749:751, 749:751].min() == 1  # one at the tip
    angle, arc = np.arctan2(*np.meshgrid(x, x)[::-1]), np.hypot(*np.meshgrid(x, x))
    for height in (3.0, 9.0, 15.0):
        middle = height if placing == "spherical" else float(CHART.arc(np.array(height)))
        ring = (np.abs(arc - middle) < 0.6) * coverage
        # round(2 pi 12 / 4.2) = 18 discs of 0.35 mm; a cap of a sphere of 12 mm has 1e-4 more, texels of 0.04 mm err by
        # some 1 % of a dot at random.
        assert (ring * area).sum() == pytest.approx(18 * np.pi * 0.35**2, rel=0.02)
        turned = np.exp(18j * angle)  # 1 at each meridian
        assert abs((ring * area * turned).sum() / (ring * area).sum()) > np.cos(18 * 0.35 / float(CHART.across(middle)))


def test_speckle_has_its_coverage_and_grain_size_all_over_the_face() -> None:
    x, area = _texels(1200)
    pattern = Speckle(kind="speckle", grain_mm=1.0, coverage=0.4, placing="spherical")
    rng = np.random.default_rng(5)
    coverage = np.mean([(round_speckle(pattern, CHART, x, x, rng) * area).sum() / area.sum() for _ in range(3)])
    assert coverage == pytest.approx(0.4, abs=0.01)
    dark = round_speckle(pattern.model_copy(update={"coverage": 0.5}), CHART, x, x, rng)

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
    image = Renderer(seen, render, SURFACE, texture, FAST).radiance(SURFACE.material, 0)
    rays = optics.look(optics.centres)
    hits = trace(SURFACE.material, SURFACE.triangles, rays.origins, rays.directions)
    places = GelMesh(SURFACE, chart).texture_coordinates().reshape(-1, 2)
    expected = 0.2 + 0.6 * hits.interpolate(SURFACE.triangles, places.astype(np.float64))
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
    given = (Render(samples_per_pixel=1), SURFACE, np.full((4, 4, 3), 0.5, np.float32), SCALAR)
    refused(r"sensor\.window\.shape = 'capsule' needs LLVM", Renderer, seen, *given)
