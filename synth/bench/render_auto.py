"""What `samples_per_pixel = "auto"` picks for draws of a scene's sensor, and the render noise that is left."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median

from synth.bench.render_error import LEVELS, measured_camera_noise
from synth.bench.render_measure import Say
from synth.bench.render_subject import alone, resized
from synth.errors import InputError
from synth.mesh import rest_surface
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.sample_count import MOST, SHARE, render_noise
from synth.render.variant import Variant
from synth.scene import Render
from synth.scene.sampling import draw, stream
from synth.scene.template import Template

SENSORS = 3
TOLERANCE = 0.03
"""Relative: of a noise that is itself estimated, in the pilots as here."""
_SEEDS = (501, 502)
"""The pilots have others."""


@dataclass(frozen=True)
class Choice:
    """For one sensor, undeformed.

    Attributes:
        sensor: number of the draw.
        samples: what "auto" picked; `fixed` is what the scene's own number comes to, 0 where that is "auto".
        seconds: of a frame with `samples`.
        camera: the camera's own noise, levels of 255, root mean square, measured in a photograph.
        noise: the renderer's with `samples`, levels.
        fixed_noise: the renderer's with `fixed`, levels.
    """

    sensor: int
    samples: int
    fixed: int
    seconds: float
    camera: float
    noise: float
    fixed_noise: float

    @property
    def share(self) -> float:
        """The renderer's noise over the camera's."""
        return self.noise / self.camera

    @property
    def met(self) -> bool:
        """Whether it is under a quarter; not where even the most samples that "auto" takes leave more."""
        return self.share <= SHARE * (1 + TOLERANCE)

    @property
    def is_capped(self) -> bool:
        """Whether "auto" would have taken more, had there been more."""
        return self.samples >= MOST


def choices(
    template: Template, seed: int, size: tuple[int, int], variant: Variant, say: Say = lambda _: None
) -> Iterator[Choice]:
    """One draw of the sensor after the other.

    Args:
        template: the scene.
        seed: of the draws.
        size: of the image, px.
        variant: that renders.
        say: told what was done, and which draws are of no use.
    """
    for number in range(SENSORS):
        try:
            yield _choice(template, seed, number, size, variant)
        except InputError as error:
            say(f"auto: sensor {number} is left out: {error}")
            continue
        say(f"auto: sensor {number} ({number + 1} of {SENSORS})")


def _choice(template: Template, seed: int, number: int, size: tuple[int, int], variant: Variant) -> Choice:
    scene = draw(template, seed, number * template.corners[0].sampling.trajectories_per_sensor)
    sensor, own = resized(alone(scene.sensor), size), scene.render
    texture = albedo(sensor, stream(template, seed, "pattern", number), template.source.parent)
    surface = rest_surface(sensor.gel)

    def noise(wanted: Render) -> tuple[int, float, float, float]:
        """Samples that are taken, the renderer's and the camera's noise in levels, and seconds."""
        renderer = Renderer(sensor, wanted, surface, texture, variant)
        pictures, seconds = [], []
        for one in _SEEDS:
            started = time.perf_counter()
            pictures.append(renderer.radiance(surface.material, one))
            seconds.append(time.perf_counter() - started)
        left = LEVELS * render_noise(pictures[0], pictures[1], sensor.camera)
        camera = measured_camera_noise(pictures[0], sensor.camera, number)
        return renderer.samples_per_pixel, left, camera, median(seconds)

    samples, left, camera, seconds = noise(own.model_copy(update={"samples_per_pixel": "auto"}))
    fixed, fixed_noise = (0, float("nan")) if own.samples_per_pixel == "auto" else noise(own)[:2]
    return Choice(number, samples, fixed, seconds, camera, left, fixed_noise)
