"""The coating's texture against closed forms: where things are, how much they cover, and what it comes from."""

import colorsys
import itertools

import numpy as np
import pytest
from commands import refused
from pydantic import ValidationError
from render_scenes import small_sensor

from synth.arrays import FloatArray
from synth.render.chart import FlatChart
from synth.render.marks import marks_coverage
from synth.render.pattern import albedo, check_pattern, is_grey, pixels_per_mm
from synth.scene import Bitmap, Coating, Dots, FurtherCamera, Light, Mirror, Pattern, RandomColor, Sensor, Speckle


def _painted(
    pattern: Pattern | None = None, seed: int = 0, white: bool = True, **camera: object
) -> tuple[Sensor, FloatArray, FloatArray, FloatArray]:
    """Sensor, texture (rows, columns, 3) and texel centres x, y of a pad of 12 x 9 mm; by the documented mapping."""
    sensor = small_sensor(pattern=pattern, **camera)
    if white:
        sensor = sensor.model_copy(update={"coating": Coating(reflectance=(1, 1, 1))})
    texture = albedo(sensor, np.random.default_rng(seed)).astype(np.float64)
    x, y = (((np.arange(n) + 0.5) / n - 0.5) * mm for n, mm in ((texture.shape[1], 12), (texture.shape[0], 9)))
    return sensor, texture, x, y


def _centroid(weight: FloatArray, x: FloatArray, y: FloatArray) -> tuple[float, float]:
    return (weight * x).sum() / weight.sum(), (weight * y[:, None]).sum() / weight.sum()


def test_strips_blend_to_the_bit_and_bare_coating_is_as_fine_as_the_camera_and_capped() -> None:
    dots = Dots(kind="dots", spacing_mm=(1.3, 1.1), radius_mm=0.4, softness_mm=0.3, reflectance=(0.1, 0.2, 0.9))
    sensor, texture, x, y = _painted(dots, seed=3, white=False)
    assert len(y) % 32
    share = marks_coverage(dots, FlatChart((1.0, 1.0)), x, y, np.random.default_rng(3))[:, :, None]
    coating = np.array(sensor.coating.reflectance)
    painted = coating + share * (np.array(dots.reflectance) - coating)
    np.testing.assert_array_equal(texture.astype(np.float32), painted.astype(np.float32))
    sensor = small_sensor()
    texture, sharp = (albedo(one, np.random.default_rng(0)) for one in (sensor, small_sensor(fx=1e5, fy=1e5)))
    assert pixels_per_mm(sensor) == pytest.approx(7.0)  # 140 px focal length over 20 mm - 6 mm + 6 mm / 1
    np.testing.assert_array_equal(texture, np.full((4 * 7 * 9, 4 * 7 * 12, 3), np.float32(0.6)), strict=True)
    assert max(sharp.shape) <= 3072


def test_grey_is_what_has_no_color_and_texture_as_fine_as_the_finest_view() -> None:
    for pattern, grey in (
        (None, True),
        (RandomColor(kind="random_color", cell_mm=1, saturation=0), True),
        (RandomColor(kind="random_color", cell_mm=1), False),
        (Speckle(kind="speckle", grain_mm=1, reflectance=(0.1, 0.1, 0.2)), False),
        (Bitmap(kind="bitmap", file="mine.png", width_mm=12), False),
    ):
        assert is_grey(small_sensor(pattern=pattern)) == grey, pattern
    red = Light(position_mm=(7, 0, 4), size_mm=(1, 1), color=(1, 0, 0), power=1)
    assert not is_grey(small_sensor(lights=(red,)))
    sensor = small_sensor(position_mm=(0.0, 0.0, 20.0), look_at_mm=(0.0, 0.0, 0.0))
    near = FurtherCamera(**(sensor.camera.model_dump() | {"name": "near", "position_mm": (0.0, 0.0, 14.0)}))
    both = sensor.model_copy(update={"further_cameras": (near,)})
    assert pixels_per_mm(both) == pytest.approx(10.0)  # 140 px over 14 mm
    mirror = Mirror(position_mm=(0.0, 0.0, 20.0), normal=(0.0, 1.0, -1.0), size_mm=(20.0, 30.0))
    aside = sensor.camera.model_copy(update={"position_mm": (0.0, 15.0, 20.0), "look_at_mm": (0.0, 0.0, 20.0)})
    folded = sensor.model_copy(update={"camera": aside, "mirrors": (mirror,)})
    assert pixels_per_mm(folded) == pytest.approx(4.0)  # 15 mm to the mirror and 20 mm from there to the gel


def test_turned_grids_turn_about_the_first_dot_and_touching_diamonds_make_a_checkerboard() -> None:
    dots = _grid(spacing_mm=(3.0, 30.0), offset_mm=(0.5, 0.2), rotation_deg=30.0)
    _, texture, x, y = _painted(dots)
    weight = 1 - texture[:, :, 0]
    near = np.hypot(x[None] - (0.5 + 3 * np.cos(np.pi / 6)), y[:, None] - (0.2 + 1.5)) < 0.7
    # +x turns toward +y. The next dot's centroid is met within a thirtieth of a texel (0.036 mm).
    assert (weight * near).sum() * (x[1] - x[0]) * (y[1] - y[0]) == pytest.approx(np.pi * 0.4**2, rel=1e-2)
    assert _centroid(weight * near, x, y) == pytest.approx((0.5 + 3 * np.cos(np.pi / 6), 1.7), abs=2e-3)
    pattern = _grid(shape="diamond", radius_mm=0.75, rotation_deg=25.0, offset_mm=(0.3, 0.2), softness_mm=0.0)
    _, texture, x, y = _painted(pattern)
    assert (1 - texture).mean() == pytest.approx(0.5, abs=0.01)  # cells cut by the pad's border: ± 1 of 96, halved
    angle = np.radians(25.0)
    u = ((x[None] - 0.3) * np.cos(angle) + (y[:, None] - 0.2) * np.sin(angle)) / 1.5
    v = ((y[:, None] - 0.2) * np.cos(angle) - (x[None] - 0.3) * np.sin(angle)) / 1.5
    # The field's own formula: cos(2 pi u) + cos(2 pi v) > 0 where |u| + |v| < 1/2, and so on with period 1.
    field = np.cos(2 * np.pi * u) + np.cos(2 * np.pi * v)
    clear = np.abs(field) > 0.3  # off the borders by 0.3 / (2 pi sqrt(2)) · 1.5 mm = 0.05 mm, more than a texel
    assert clear.mean() > 0.7
    assert np.array_equal(texture[:, :, 0][clear] < 0.5, field[clear] > 0)


def _grid(**changes: object) -> Dots:
    """Black dots in the middles of 8 x 6 cells that fill the pad of 12 x 9 mm."""
    numbers = {"spacing_mm": (1.5, 1.5), "radius_mm": 0.4, "offset_mm": (0.75, 0.75), "reflectance": (0, 0, 0)}
    return Dots(kind="dots", **(numbers | changes))


@pytest.mark.parametrize("shape", ["round", "diamond"])
def test_dots_cover_their_area_and_sit_on_the_grid(shape: str) -> None:
    pattern = _grid(shape=shape, softness_mm=0.1, spacing_mm=(1.5, 1.125), offset_mm=(0.75, 0.5625))
    _, texture, x, y = _painted(pattern)
    dark = 1 - texture[:, :, 0]
    # A linear ramp of width w averages the area over offsets of the edge by ±w/2: pi (r² + w²/12), 2 r² + w²/3.
    area = np.pi * (0.4**2 + 0.1**2 / 12) if shape == "round" else 2 * 0.4**2 + 0.1**2 / 3
    # Texels of 0.036 mm sample a ramp of 0.1 mm, whose kinks leave errors of second order; seen: 3e-4 and 6e-4.
    assert dark.mean() == pytest.approx(area / (1.5 * 1.125), rel=2e-3)
    for cx, cy in itertools.product((-5.25, -0.75, 3.75), (-3.9375, 0.5625, 2.8125)):
        near = dark * (np.abs(x[None] - cx) < 0.75) * (np.abs(y[:, None] - cy) < 0.5625)
        assert _centroid(near, x, y) == pytest.approx((cx, cy), abs=1.2e-3)  # a thirtieth of a texel


def test_jitter_moves_and_sizes_dots_by_what_is_asked() -> None:
    loose = {"jitter_mm": 0.04, "radius_jitter": 0.1, "softness_mm": 0.0}
    pattern = _grid(spacing_mm=(0.75, 0.75), offset_mm=(0.375, 0.375), radius_mm=0.15, **loose)
    _, texture, x, y = _painted(pattern, seed=4, fx=280.0, fy=280.0)
    dark, moved, areas = 1 - texture[:, :, 0], [], []
    for cx, cy in itertools.product(np.arange(-5.625, 6, 0.75), np.arange(-4.125, 4.5, 0.75)):
        near = dark * (np.abs(x[None] - cx) < 0.375) * (np.abs(y[:, None] - cy) < 0.375)
        areas.append(near.sum())
        moved.append(np.subtract(_centroid(near, x, y), (cx, cy)))
    dx, dy = np.array(moved).T
    # 192 dots: a standard deviation is known to 1 / sqrt(2 · 192) = 5 %; three of those. A correlation to 7 %.
    assert (dx.std(), dy.std()) == pytest.approx((0.04, 0.04), rel=0.15)
    assert abs(np.corrcoef(dx, dy)[0, 1]) < 0.21
    assert np.std(areas) / np.mean(areas) == pytest.approx(2 * 0.1, rel=0.16)  # (1 + e)² varies by 2 e


def test_neighbouring_random_colors_differ_in_hue_and_fill_the_circle() -> None:
    _, texture, x, y = _painted(RandomColor(kind="random_color", cell_mm=0.5, saturation=1.0, softness_mm=0.0), seed=2)
    steps = [np.abs(np.diff(texture, axis=axis)).sum(axis=(1 - axis, 2)) for axis in (1, 0)]
    cells = [_middles(step, place) for step, place in zip(steps, (x, y), strict=True)]
    found = [[colorsys.rgb_to_hsv(*texture[row, column]) for column in cells[0]] for row in cells[1]]
    hue, saturation, value = np.moveaxis(np.array(found), 2, 0)
    assert min(hue.shape) >= 15
    apart = [np.abs(np.diff(hue, axis=axis)) for axis in (0, 1)]
    alike = [np.minimum(a, 1 - a) < 1 / 8 - 1e-3 for a in apart]
    assert np.mean(np.concatenate([a.ravel() for a in alike])) < 0.01
    counts = np.histogram(hue, 6, (0, 1))[0] / hue.size
    # Near even; neighbours repel each other, which only evens it out. 400 cells: 1/6 ± 0.019.
    assert counts == pytest.approx(1 / 6, abs=0.06)
    assert 0.35 - 1e-6 <= value.min() < 0.42
    assert 0.93 < value.max() <= 1
    assert 0.6 - 1e-3 <= saturation.min() < 0.68


def _middles(steps: FloatArray, place: FloatArray) -> list[int]:
    """Indices of the middles of the cells whose borders are where the colour steps."""
    borders = [k for k in range(1, len(steps) - 1) if steps[k] > 1.0 and steps[k] >= steps[k - 1 : k + 2].max()]
    borders = [k for n, k in enumerate(borders) if n == 0 or place[k] - place[borders[n - 1]] > 0.3]
    return [(a + b + 1) // 2 for a, b in itertools.pairwise(borders)]


@pytest.mark.parametrize("grain", [0.4, 0.8])
def test_speckle_covers_what_is_asked_and_has_its_grain(grain: float) -> None:
    """Rice's formula for filtered noise: 4 / (pi sqrt(2) grain) crossings per mm at half coverage."""
    speckles = (Speckle(kind="speckle", grain_mm=grain, coverage=c, reflectance=(0, 0, 0)) for c in (0.35, 0.5))
    sparse, half = (_painted(speckle, seed=7)[1][:, :, 0] for speckle in speckles)
    # The cut is a quantile of this very texture; only the slope of the density across the edge remains: below 1 %.
    assert (1 - sparse).mean() == pytest.approx(0.35, abs=0.01)
    dark = half < 0.5
    across, down = (np.count_nonzero(np.diff(dark, axis=axis)) / dark.shape[1 - axis] for axis in (1, 0))
    crossings = (across / 12 + down / 9) / 2  # per mm
    # About 108 mm² / grain² = 170 grains of 0.8 mm, each crossed in many places: 1 / sqrt(170) = 8 %, two directions.
    # Crossings closer than a texel (0.036 mm) are missed: of 0.2 mm of filter, some 1 %.
    assert crossings == pytest.approx(4 / (np.pi * np.sqrt(2) * grain), rel=0.08)


@pytest.mark.parametrize(("pattern", "field"), [
    (Dots(kind="dots", spacing_mm=(1, 0.03), radius_mm=0.02), "spacing_mm"),
    (RandomColor(kind="random_color", cell_mm=0.03), "cell_mm"),
    (Speckle(kind="speckle", grain_mm=0.03), "grain_mm"),
])  # fmt: skip
def test_what_no_pixel_shows_is_refused(pattern: Pattern, field: str, tmp_path) -> None:
    """A quarter of a pixel, one texel, is 0.0357 mm here: 140 px of focal length over 20 mm."""
    sensor = small_sensor(pattern=pattern)
    words = rf"sensor\.pattern\.{field} = 0\.03: .*at least 0\.0357"
    refused(words, albedo, sensor, np.random.default_rng(0))
    refused(words, check_pattern, sensor, tmp_path)


@pytest.mark.parametrize(("shape", "most"), [("round", 0.8), ("diamond", 1.1)])
def test_dots_that_leave_no_coating_are_refused(shape: str, most: float) -> None:
    """Round dots meet in the middle of four at half the diagonal, diamonds at half the sum of the spacings."""
    spacing = (0.96, 1.28) if shape == "round" else (1.0, 1.2)
    _grid(shape=shape, spacing_mm=spacing, radius_mm=0.99 * most)
    with pytest.raises(ValidationError, match="cover everything"):
        _grid(shape=shape, spacing_mm=spacing, radius_mm=1.001 * most)
