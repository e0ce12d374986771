"""The coating's texture: where things are, how much they cover, and that they come from the generator alone."""

import numpy as np
import pytest
from render_scenes import small_sensor

from synth.render.marks import dots_coverage
from synth.render.pattern import albedo, is_grey, pixels_per_mm
from synth.scene import Dots, FurtherCamera, Light, Mirror, NoPattern, RandomColor, Speckle


def _texel_mm(sensor, texture):
    """Centres of the texels: x (columns,) and y (rows,), from the documented mapping."""
    (width, height), (rows, columns) = sensor.gel.size_mm[:2], texture.shape[:2]
    return ((np.arange(columns) + 0.5) / columns - 0.5) * width, ((np.arange(rows) + 0.5) / rows - 0.5) * height


def test_bare_coating_is_uniform() -> None:
    texture = albedo(small_sensor(), np.random.default_rng(0))
    assert texture.dtype == np.float32
    assert np.all(texture == np.float32(0.6))


def test_dot_lies_where_the_scene_says_and_has_its_area() -> None:
    dots = Dots(kind="dots", spacing_mm=(30, 30), radius_mm=0.7, offset_mm=(2.0, -1.5), reflectance=(0, 0, 0))
    sensor = small_sensor(pattern=dots)
    texture = albedo(sensor, np.random.default_rng(0))
    x, y = _texel_mm(sensor, texture)
    weight = 1 - texture[:, :, 0] / 0.6
    area = weight.sum() * (x[1] - x[0]) * (y[1] - y[0])
    # The antialiased edge keeps the area to second order in its width w: pi w² / 12 / (pi R²) = 4e-4 for w = 0.05 mm.
    assert area == pytest.approx(np.pi * 0.7**2, rel=2e-3)
    assert (weight * x).sum() / weight.sum() == pytest.approx(2.0, abs=1e-3)
    assert (weight * y[:, None]).sum() / weight.sum() == pytest.approx(-1.5, abs=1e-3)


def test_strips_blend_as_the_whole_to_the_bit() -> None:
    """Fails with the last, shorter strip left out, and with rows of a strip's coverage taken for the next one's."""
    dots = Dots(kind="dots", spacing_mm=(1.3, 1.1), radius_mm=0.4, softness_mm=0.3, reflectance=(0.1, 0.2, 0.9))
    sensor = small_sensor(pattern=dots)
    texture = albedo(sensor, np.random.default_rng(3))
    x, y = _texel_mm(sensor, texture)
    assert len(y) % 32
    share = dots_coverage(dots, x, y, np.random.default_rng(3))[:, :, None]
    coating = np.array(sensor.coating.reflectance)
    painted = coating + share * (np.array(dots.reflectance) - coating)
    np.testing.assert_array_equal(texture, painted.astype(np.float32))


def test_resolution_follows_the_camera_and_is_capped() -> None:
    sensor = small_sensor()
    # 140 px focal length over 20 mm - 6 mm + 6 mm / 1
    assert pixels_per_mm(sensor) == pytest.approx(7.0)
    assert albedo(sensor, np.random.default_rng(0)).shape == (4 * 7 * 9, 4 * 7 * 12, 3)
    sharp = small_sensor(fx=1e5, fy=1e5)
    assert max(albedo(sharp, np.random.default_rng(0)).shape) <= 3072


def test_random_colors_differ_from_cell_to_cell() -> None:
    sensor = small_sensor(pattern=RandomColor(kind="random_color", cell_mm=1.0, softness_mm=0.0))
    texture = albedo(sensor, np.random.default_rng(3))
    assert texture.max() <= np.float32(0.6)  # a white cell reflects as the bare coating
    # Steps along a row: one per cell and nowhere else. 12 mm hold 11 or 12 borders.
    row = np.abs(np.diff(texture[100], axis=0)).sum(1) > 0.02
    borders = np.count_nonzero(row & ~np.roll(row, 1))
    assert 11 <= borders <= 12


def test_speckle_covers_what_is_asked() -> None:
    pattern = Speckle(kind="speckle", grain_mm=0.5, coverage=0.35, reflectance=(0, 0, 0))
    texture = albedo(small_sensor(pattern=pattern), np.random.default_rng(1))
    # The cut is a quantile of this very texture; only the slope of the density across the edge remains: below 1 %.
    assert (1 - texture[:, :, 0] / 0.6).mean() == pytest.approx(0.35, abs=0.01)


@pytest.mark.parametrize(
    "pattern",
    [
        Dots(kind="dots", spacing_mm=(1, 1), radius_mm=0.2, jitter_mm=0.1, radius_jitter=0.2),
        RandomColor(kind="random_color", cell_mm=0.5),
        Speckle(kind="speckle", grain_mm=0.4),
    ],
)
def test_pattern_comes_from_the_generator_alone(pattern) -> None:
    first, again, other = (albedo(small_sensor(pattern=pattern), np.random.default_rng(seed)) for seed in (5, 5, 6))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.min() >= 0
    assert first.max() <= 1


def test_grey_is_what_has_no_color_anywhere() -> None:
    assert is_grey(small_sensor(pattern=NoPattern(kind="none")))
    assert is_grey(small_sensor(pattern=RandomColor(kind="random_color", cell_mm=1, saturation=0)))
    assert not is_grey(small_sensor(pattern=RandomColor(kind="random_color", cell_mm=1)))
    assert not is_grey(small_sensor(pattern=Speckle(kind="speckle", grain_mm=1, reflectance=(0.1, 0.1, 0.2))))
    red = Light(position_mm=(7, 0, 4), size_mm=(1, 1), color=(1, 0, 0), power=1)
    assert not is_grey(small_sensor(lights=(red,)))


def test_texture_is_as_fine_as_the_finest_view_sees_it() -> None:
    """Fails with the main camera's height for its distance: gelslim's goes by a mirror, and gave 4 times too fine."""
    sensor = small_sensor(position_mm=(0.0, 0.0, 20.0), look_at_mm=(0.0, 0.0, 0.0))
    near = FurtherCamera(**(sensor.camera.model_dump() | {"name": "near", "position_mm": (0.0, 0.0, 14.0)}))
    both = sensor.model_copy(update={"further_cameras": (near,)})
    assert pixels_per_mm(both) == pytest.approx(10.0)  # 140 px over 14 mm
    mirror = Mirror(position_mm=(0.0, 0.0, 20.0), normal=(0.0, 1.0, -1.0), size_mm=(20.0, 30.0))
    aside = sensor.camera.model_copy(update={"position_mm": (0.0, 15.0, 20.0), "look_at_mm": (0.0, 0.0, 20.0)})
    folded = sensor.model_copy(update={"camera": aside, "mirrors": (mirror,)})
    assert pixels_per_mm(folded) == pytest.approx(4.0)  # 15 mm to the mirror and 20 mm from there to the gel


def test_a_turned_grid_turns_about_its_first_dot() -> None:
    dots = Dots(kind="dots", spacing_mm=(3.0, 30.0), radius_mm=0.4, offset_mm=(0.5, 0.2), rotation_deg=30.0,
                reflectance=(0, 0, 0))  # fmt: skip
    sensor = small_sensor(pattern=dots)
    texture = albedo(sensor, np.random.default_rng(0))
    x, y = _texel_mm(sensor, texture)
    weight = 1 - texture[:, :, 0] / 0.6
    near = np.hypot(x[None] - (0.5 + 3 * np.cos(np.pi / 6)), y[:, None] - (0.2 + 1.5)) < 0.7
    # +x turns toward +y. The next dot's centroid is met within a thirtieth of a texel (0.036 mm).
    assert (weight * near).sum() * (x[1] - x[0]) * (y[1] - y[0]) == pytest.approx(np.pi * 0.4**2, rel=1e-2)
    assert (weight * near * x).sum() / (weight * near).sum() == pytest.approx(0.5 + 3 * np.cos(np.pi / 6), abs=2e-3)
    assert (weight * near * y[:, None]).sum() / (weight * near).sum() == pytest.approx(1.7, abs=2e-3)
