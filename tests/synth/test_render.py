"""The renderer: radiometry, energy and geometry against closed forms, exact reproducibility, and what it leaves out."""

import hashlib
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import render_scenes
from commands import refused
from render_scenes import DIRECT, FAST, SCALAR, VARIANTS, flat_surface, needs_llvm, plain, rendered, small_sensor

import synth.render.renderer as renderer_module
from synth.render import path_tracer
from synth.render.pattern import albedo
from synth.render.renderer import Renderer, full_grid
from synth.render.variant import Variant
from synth.scene import Coating, Dots, Light, Render, Sensor, Speckle

MONO = replace(FAST, name="llvm_ad_mono")
names = {"ids": lambda value: value.name if isinstance(value, Variant) else str(value)}


@pytest.mark.parametrize("variant", VARIANTS, **names)
@pytest.mark.parametrize("index", [1.0, 1.45])
def test_radiance_of_a_flat_lambertian_face_under_a_small_light(variant: Variant, index: float) -> None:
    """L = ρ/π · Φ/π · (1 - F) / n² Σ cos θ_light cos θ_face / d² · R, at the middle of the image."""
    sensor = small_sensor(index)
    image = rendered(sensor, variant=variant)
    light = sensor.lights[0]
    # The sum is over the light (R = 1) and its mirror image behind the window, which scalar variants leave out.
    images = (False, True) if variant.is_vectorised and index > 1 else (False,)
    # Seen straight down, at the principal point; reflection changes fast near the critical angle, so pixel by pixel.
    pitch = (14 + 6 / index) / 140
    feet = [np.array([0.2 + pitch * x, -0.1 + pitch * y, 0.0]) for x, y in product(range(-2, 3), repeat=2)]
    irradiance = np.mean([sum(_small_light(light, foot, image, index) for image in images) for foot in feet])
    reflected = ((index - 1) / (index + 1)) ** 2
    expected = 0.6 / np.pi * irradiance * (1 - reflected) / index**2
    # Mitsuba's scalar window drops the reflected share by chance: of 900 samples, F = 3 % ± 0.6 %.
    tolerance = 1e-3 if variant.is_vectorised or index == 1 else 2e-2
    assert image[26:31, 40:45].mean((0, 1)) == pytest.approx(expected, rel=tolerance)


def _small_light(light: Light, foot: np.ndarray, is_image: bool, index: float) -> float:
    """Irradiance by a point-like light that aims at the origin, or by its mirror image in z = 6."""
    position, direction = np.array(light.position_mm), -np.array(light.position_mm)
    if is_image:
        position[2], direction[2] = 12 - position[2], -direction[2]
    arm = foot - position
    distance = np.linalg.norm(arm)
    cosine = position[2] / distance
    leaving = max(arm @ direction / np.linalg.norm(direction) / distance, 0.0)
    reflected = render_scenes.internal_reflectance(cosine, index) if is_image else 1
    return light.power / np.pi * leaving * cosine / distance**2 * reflected


@pytest.mark.parametrize("variant", VARIANTS, **names)
@pytest.mark.parametrize("index", [1.0, 1.45])
def test_dots_are_seen_where_pinhole_and_snell_put_them(variant: Variant, index: float) -> None:
    errors = _dot_errors(small_sensor(index, _dots()), variant)
    # Mitsuba's scalar window loses 3 % ± 1 % of a pixel's samples at random, 2e-2 px for a single dot: three of those.
    noise = 0.06 if index > 1 and not variant.is_vectorised else 0.02
    assert errors == pytest.approx(0, abs=noise)
    assert errors.mean(0) == pytest.approx(0, abs=0.02)


@needs_llvm
def test_lens_distortion_and_oblong_pixels_are_exact() -> None:
    lens = {"fy": 155.0, "distortion": (-0.25, 0.08, 0.004, -0.003, 0.01)}
    assert _dot_errors(small_sensor(1.41, _dots(), **lens), FAST) == pytest.approx(0, abs=0.02)


def _dots() -> Dots:
    return Dots(kind="dots", spacing_mm=(2.5, 2.0), radius_mm=0.45, offset_mm=(0.3, 0.1), reflectance=(0.1, 0.1, 0.1))


def _dot_errors(sensor, variant) -> np.ndarray:
    """Centroid minus expected pixel (n, 2) of every dot that lies wholly in the image.

    A jittered grid of 144 samples leaves below 1e-2 of a pixel's coverage, over some 20 edge pixels of a dot of 30 px
    at a lever of 3 px: 4e-3 px. The perspective of a disk 0.9 mm wide moves its centroid by less than 0.01 px.
    """
    render = Render(samples_per_pixel=144, max_depth=2)
    texture = albedo(sensor, np.random.default_rng(0))
    dotted, bare = (rendered(sensor, painted, render, variant)[:, :, 0] for painted in (texture, plain()))
    ratio = dotted / bare
    if not variant.is_vectorised and sensor.window.refractive_index > 1:
        ratio = np.where(ratio > 0.9, 1, ratio)  # the scalar window's chance losses, away from the dots
    darkness = np.clip(1 - ratio, 0, None)
    rows, columns = np.mgrid[0:60, 0:80] + 0.5
    errors = []
    for x, y in product(np.arange(-2, 3) * 2.5 + 0.3, np.arange(-2, 3) * 2.0 + 0.1):
        u, v = render_scenes.refracted_pixel(sensor, x, y)
        if 7 < u < 73 and 7 < v < 53:
            weight = darkness * (np.hypot(columns - u, rows - v) < 6.5)
            errors.append([(weight * (columns - u)).sum() / weight.sum(), (weight * (rows - v)).sum() / weight.sum()])
    assert len(errors) >= 9
    return np.array(errors)


@pytest.mark.parametrize("variant", VARIANTS, **names)
def test_same_seed_same_bits_and_other_seed_other_noise(variant: Variant) -> None:
    sensor = small_sensor(1.45, _dots())
    surface, texture = flat_surface(sensor), albedo(sensor, np.random.default_rng(0))
    renderer = Renderer(sensor, DIRECT, surface, texture, variant)
    raised = surface.material + np.array([0.3, 0.1, 0.4])
    takes = ((surface.material, 7), (raised, 7), (surface.material, 7), (surface.material, 2**40 + 7))
    first, moved, again, other = (renderer.radiance(*take) for take in takes)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, moved)
    assert not np.array_equal(first, other)
    assert (first.shape, first.dtype) == ((60, 80, 3), np.float32)


@pytest.mark.parametrize("variant", VARIANTS, **names)
def test_another_surface_is_rendered_as_by_a_renderer_of_its_own(variant: Variant) -> None:
    sensor = small_sensor(1.45, _dots())
    texture, surfaces = albedo(sensor, np.random.default_rng(0)), [flat_surface(sensor, n) for n in (4, 9, 2)]
    renderer = Renderer(sensor, DIRECT, surfaces[0], texture, variant)
    for surface in surfaces[1:]:
        raised = surface.material + np.array([0.3, 0.1, 0.4])
        raised[:, 2] += 0.1 * raised[:, 0]
        renderer.take(surface)
        own = Renderer(sensor, DIRECT, surface, texture, variant)
        assert np.array_equal(renderer.radiance(raised, 3), own.radiance(raised, 3))


THREADS = """
import sys
sys.path.insert(0, sys.argv[2])
import test_render as t
t.FAST.load()
import drjit as dr
dr.set_thread_count(int(sys.argv[1]))
print(t.bumpy_frame_hash())
"""


def bumpy_frame_hash() -> str:
    """Digest of a frame with everything that could depend on the order of sums: bump, window, indirect light."""
    sensor = small_sensor(1.45, _dots(), width=160, height=120, fx=280.0, fy=280.0, cx=80.0, cy=60.0)
    surface = flat_surface(sensor, 24)
    positions = surface.material.copy()
    positions[:, 2] += np.exp(-(positions[:, :2] ** 2).sum(1))
    render, texture = Render(samples_per_pixel=36, max_depth=3), albedo(sensor, np.random.default_rng(0))
    image = rendered(sensor, texture, render, seed=1, positions=positions, cells=24)
    return hashlib.sha256(image.tobytes()).hexdigest()


@needs_llvm
def test_bits_do_not_depend_on_the_number_of_threads() -> None:
    here = Path(__file__).parent
    commands = [[sys.executable, "-c", THREADS, str(threads), str(here)] for threads in (1, 3)]
    runs = [subprocess.run(one, cwd=here.parents[1], capture_output=True, check=True) for one in commands]
    assert runs[0].stdout == runs[1].stdout != b""


@needs_llvm
@pytest.mark.parametrize("render", [DIRECT, Render(samples_per_pixel=36, light="separated")])
def test_nothing_is_compiled_for_another_frame_or_another_draw_of_the_sensor(render: Render) -> None:
    """Nor while other scenes' shapes are still alive."""
    FAST.load()
    import drjit as dr

    kept = []

    def compiled(sensor: Sensor, *seeds: int) -> list[int]:
        surface = flat_surface(sensor)
        bump = np.exp(-(surface.material[:, :2] ** 2).sum(axis=1, keepdims=True)) * [0, 0, 1.0]
        renderer = Renderer(sensor, render, surface, plain(), FAST)
        kept.append(renderer)
        frames = (lambda k=k: renderer.radiance(surface.material + k * bump, k) for k in seeds)
        return [render_scenes.kernels_compiled(frame) for frame in frames]

    light = Light(position_mm=(-6.5, 1.0, 3.0), size_mm=(1, 2), color=(1, 0.5, 0), power=70)
    other = small_sensor(1.41, lights=(light,), fx=143.0, fy=141.0, cx=40.0, position_mm=(0.1, 0.0, 21.0))
    lenses = ({"aperture_mm": aperture, "focus_mm": focus} for aperture, focus in ((1.0, 20.0), (1.3, 17.0)))
    wide, narrow = (small_sensor(1.45, **lens) for lens in lenses)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for first, second in ((small_sensor(1.45), other), (wide, narrow)):
            compiled(first, 0, 1)
            assert compiled(second, 2, 3) == [0, 0]


@needs_llvm
def test_grey_scenes_look_the_same_in_one_channel_and_light_brightens_the_slope_that_faces_it() -> None:
    separated = DIRECT.model_copy(update={"light": "separated"})
    grains = Speckle(kind="speckle", grain_mm=0.8, reflectance=(0.1, 0.1, 0.1), layer="above_coating")
    shining = {"coating": Coating(reflectance=(0.5, 0.5, 0.5), roughness=0.4, metallic=0.8)}
    for index, render, pattern, coating in ((1.0, DIRECT, grains, shining), (1.45, separated, _dots(), {})):
        sensor = small_sensor(index, pattern).model_copy(update=coating)
        texture = albedo(sensor, np.random.default_rng(0))
        color, mono = (rendered(sensor, texture, render, variant=one) for one in (FAST, MONO))
        # The same samples; only the luminance weights 0.2126 + 0.7152 + 0.0722 round differently.
        assert mono == pytest.approx(color, rel=1e-5)
    red = Light(position_mm=(7, 0, 4), size_mm=(1, 1), color=(1, 0, 0), power=1)
    with pytest.raises(ValueError, match="grey"):
        rendered(small_sensor(lights=(red,)), variant=MONO)
    # A dent toward the camera: the flank on the side of the light is lit, the other shaded, in x as in y.
    flanks = np.s_[25:35, 46:52], np.s_[25:35, 28:34], np.s_[36:42, 35:45], np.s_[18:24, 35:45]
    for position, bright, dark in (((7.0, 0.0, 3.0), *flanks[:2]), ((0.0, 5.5, 3.0), *flanks[2:])):
        light = Light(position_mm=position, size_mm=(1, 1), color=(1, 1, 1), power=100)
        sensor = small_sensor(lights=(light,), cx=40.0, cy=30.0, position_mm=(0, 0, 20), look_at_mm=(0, 0, 0))
        surface = flat_surface(sensor, 24)
        dented = surface.material.copy()
        dented[:, 2] += np.exp(-(dented[:, :2] ** 2).sum(1) / 2)
        renderer = Renderer(sensor, DIRECT, surface, plain(), FAST)
        change = renderer.radiance(dented, 0) - renderer.radiance(surface.material, 0)
        assert change[bright].mean() > 0 > change[dark].mean()


@pytest.mark.parametrize("variant", VARIANTS, **names)
def test_beside_the_pad_it_is_black(variant: Variant) -> None:
    light = Light(position_mm=(17.0, 0.0, 5.5), size_mm=(1, 1), color=(1, 1, 1), power=1000)
    sensor = small_sensor(lights=(light,), fx=40.0, fy=40.0, cx=40.0, cy=30.0)  # 2 px per mm: 24 x 18 px of pad
    image = rendered(sensor, variant=variant)
    assert not image[:8].any()
    assert not image[:, :10].any()
    assert np.all(image[25:35, 35:45] > 0)


def test_samples_fill_a_grid_and_lights_in_the_view_and_scalar_lenses_are_refused() -> None:
    for samples, lights in product((1, 5, 32, 100), (0, 1, 3, 4, 9)):
        got = full_grid(samples, lights)
        assert got >= samples
        assert got % int(np.sqrt(got)) == got % max(lights, 1) == 0
    assert full_grid(36, 3) == 36
    light = Light(position_mm=(1.0, 0.0, 3.0), size_mm=(1, 1), color=(1, 1, 1), power=1)
    refused(r"lights\[0\].*between the camera and the gel", rendered, small_sensor(lights=(light,)))
    for field, change in (("distortion", {"distortion": (0.1, 0, 0, 0, 0)}), ("fx", {"fy": 150.0})):
        refused(f"{field}.*LLVM", rendered, small_sensor(**change), variant=SCALAR)


@needs_llvm
def test_white_furnace(monkeypatch: pytest.MonkeyPatch) -> None:
    """A white, deeply dented face in a box whose walls and ceiling shine with the radiance 1 has it everywhere."""
    radiant = {"size_mm": (200.0, 200.0), "color": (1, 1, 1), "power": np.pi * 200**2}
    walls = [(100.0, 0.0), (-100.0, 0.0), (0.0, 100.0), (0.0, -100.0)]
    lights = [Light(position_mm=(x, y, 90.0), aim_mm=(0.0, 0.0, 90.0), **radiant) for x, y in walls]
    lights.append(Light(position_mm=(0.0, 0.0, 190.0), aim_mm=(0.0, 0.0, 0.0), **radiant))
    for module in (renderer_module, path_tracer):
        monkeypatch.setattr(module, "all_lights", lambda sensor: tuple(lights))
    sensor = small_sensor(position_mm=(0.0, 0.0, 20.0), look_at_mm=(0.0, 0.0, 0.0), cx=40.0, cy=30.0)
    surface = flat_surface(sensor, 24)
    bowl = surface.material.copy()
    bowl[:, 2] -= 3 * np.exp(-(bowl[:, :2] ** 2).sum(axis=1) / 2)
    image = rendered(sensor, plain(1.0), Render(samples_per_pixel=64, max_depth=24), positions=bowl, cells=24)
    middle, face = image[25:35, 35:45, 0], image[25:35, 8:16, 0]
    # Paths are cut at 24 surfaces, which leaves nothing. A pixel's noise is about 1 %, that of 100 pixels 0.1 %.
    # In the bowl, shading normals that differ from the facets' lose some grazing light.
    assert face.mean() == pytest.approx(1, rel=3e-3)
    assert middle.mean() == pytest.approx(1, rel=1e-2)


@needs_llvm
def test_irradiance_under_a_large_light_is_the_sum_over_it() -> None:
    """A rectangle of radiance L parallel to the face, beside its foot: E = π L F with the view factor F."""
    light = Light(position_mm=(5.0, 0.0, 3.0), aim_mm=(5.0, 0.0, 0.0), size_mm=(4.0, 6.0), color=(1, 1, 1), power=300)
    foot = np.array([-1.5, -0.1])  # seen at the principal point
    view = {"position_mm": (*foot, 20.0), "look_at_mm": (*foot, 0.0)}
    image = rendered(small_sensor(lights=(light,), fx=500.0, fy=500.0, **view))
    u = (np.arange(400) + 0.5) / 400 - 0.5  # By 400 x 400 midpoints of cos² / (π r²), whose error is 1e-5
    x, y = np.meshgrid(5 + 4 * u - foot[0], 6 * u - foot[1])
    factor = (9 / (np.pi * (x**2 + y**2 + 9) ** 2)).mean() * 24
    expected = 0.6 / np.pi * np.pi * 300 / (np.pi * 24) * factor
    # 36 stratified samples: 2 % a pixel, 0.2 % in the mean of 9 x 9 px; the curvature over 0.4 mm below 0.1 %.
    assert image[24:33, 38:47].mean() == pytest.approx(expected, rel=6e-3)
