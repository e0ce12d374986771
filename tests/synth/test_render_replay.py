"""Frames that Dr.Jit replays are those that it would record: the same bits, whatever was rendered before."""

import numpy as np
from render_scenes import FAST, flat_surface, needs_llvm, plain, small_sensor

from synth.render.renderer import Recordings, Renderer
from synth.scene import Dots, Light, Render

RENDER = Render(samples_per_pixel=4, max_depth=3, light="separated")
OTHER = Render(samples_per_pixel=9, max_depth=2, light="separated")


def _sensor(power: float, x: float):
    lights = tuple(Light(position_mm=(x, y, 3.0), size_mm=(3, 1), color=(1, 1, 1), power=power) for y in (1.0, -2.0))
    return small_sensor(
        1.45, Dots(kind="dots", spacing_mm=(2, 2), radius_mm=0.4), lights, width=40, height=30, cx=20 + x
    )


class _Unrecorded(Recordings):
    def of(self, function, *static):
        return lambda *values: function(*values, *static)


@needs_llvm
def test_reused_and_replayed_frames_have_the_bits_of_new_renderers_that_record_nothing() -> None:
    """At rest and pressed in turn, of one sensor and then of others, on two sizes of mesh; samples and depth differ."""
    sensors, textures = (_sensor(400, -6.0), _sensor(300, 6.5)), (plain(0.8), plain(0.5))
    surfaces = [flat_surface(sensors[0], cells) for cells in (8, 10)]
    shared = Renderer(sensors[0], RENDER, surfaces[0], textures[0], FAST)
    numbers = [(0, 0, 0, RENDER), (1, 1, 1, RENDER), (1, 0, 0, OTHER), (0, 0, 0, RENDER)]
    for number, (sensor, texture, surface, render) in enumerate(numbers):
        drawn = (sensors[sensor], render, surfaces[surface], textures[texture])
        assert number == 0 or shared.reuse(*drawn)
        own = Renderer(*drawn, FAST)
        own._recordings = _Unrecorded()
        for step in range(4):
            positions = drawn[2].material.copy()
            positions[:, 2] += (step % 2) * 1.5 * np.exp(-((positions[:, 0] - 0.1 * step) ** 2 + positions[:, 1] ** 2))
            found = shared.radiance(positions, step)
            np.testing.assert_array_equal(found, own.radiance(positions, step))
        assert found.std() > 0.01
    fewer = sensors[0].model_copy(update={"lights": sensors[0].lights[:1]})
    assert not shared.reuse(fewer, RENDER, surfaces[0], textures[0])
    assert not shared.reuse(sensors[0], Render(), surfaces[0], textures[0]), "path traced"
