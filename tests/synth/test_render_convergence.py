"""Error of rendered images against samples per pixel and path depth, on a bump whose flanks light the plain around."""

from functools import cache

import numpy as np
import pytest
from render_scenes import flat_surface, plain, small_sensor

from benchmarks.image_error import errors
from synth.render.renderer import Renderer
from synth.render.variant import choose_variant
from synth.scene import Light, Render

FAST = choose_variant("cpu")
needs_llvm = pytest.mark.skipif(not FAST.is_vectorised, reason="no LLVM of version 16 or newer here")
DEEPEST = 8
LIGHTS = tuple(Light(position_mm=(x, 1.0, 3.0), size_mm=(3, 1), color=(1, 1, 1), power=400) for x in (-7.0, 7.0))
SENSOR = small_sensor(1.45, None, LIGHTS, width=40, height=30, fx=70.0, fy=70.0, cx=21.25, cy=14.25, blur_px=0.8)


@cache
def measured() -> dict[tuple[int, int], dict[str, float]]:
    """Errors by path depth and samples, against a reference of the deepest paths."""
    surface, texture = flat_surface(SENSOR, 24), plain(0.8)
    pressed = surface.material.copy()
    pressed[:, 2] += 1.5 * np.exp(-(pressed[:, 0] ** 2 + pressed[:, 1] ** 2) / 1.2**2)

    def images(depth: int, samples: int, seeds: range) -> list[np.ndarray]:
        render = Render(samples_per_pixel=samples, max_depth=depth, light="path_traced")
        renderer = Renderer(SENSOR, render, surface, texture, FAST)
        return [renderer.radiance(pressed, seed) for seed in seeds]

    first, second = images(DEEPEST, 350, range(1, 3))
    settings = [(DEEPEST, 16), (DEEPEST, 64), (DEEPEST, 256), (2, 64)]
    return {
        one: errors(images(*one, range(1000 * k, 1000 * k + 3)), (first, second), SENSOR.camera)
        for k, one in enumerate(settings, 1)
    }


@needs_llvm
def test_noise_falls_as_the_root_of_samples() -> None:
    """Independent samples: -1/2. Stratified ones are never worse, and fall faster by what they resolve of it."""
    counts = (16, 64, 256)
    slope = np.polyfit(np.log(counts), np.log([measured()[DEEPEST, n]["noise"] for n in counts]), 1)[0]
    # 1200 pixels, blurred: some 1200 / (4 pi 0.8²) = 150 independent values and 2 degrees of freedom each: noise within
    # 1 / sqrt(2 · 300) = 4 %, the slope over a factor of 16 within 0.04 sqrt(2) / ln 16 = 0.02; 4 times that above.
    # Below: a jittered grid over an edge has variance n^-3/2 (Mitchell 1996), and paths are only partly stratified.
    assert -0.75 < slope < -0.5 + 0.08


@needs_llvm
def test_full_paths_have_no_bias_and_cut_ones_are_seen() -> None:
    """A path of 2 is direct light only; here it lacks 1.2 % of the light."""
    for n in (16, 64, 256):
        found = measured()[DEEPEST, n]
        assert abs(found["bias_percent"]) < 4 * found["bias_se_percent"]
        assert found["systematic"] < 2 * found["systematic_limit"]  # the limit is two standard errors: four
    cut = measured()[2, 64]
    assert cut["bias_percent"] < -10 * cut["bias_se_percent"]
    assert cut["systematic"] > 3 * cut["systematic_limit"]
