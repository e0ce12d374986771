"""Radiance of trajectories' frames: one renderer, kept until another sensor is wanted.

Nothing here depends on which other trajectories were rendered before: renderer and undeformed frame are a pure function
of (scene, seed, sensor), and every frame has a seed of its own.
"""

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

from synth.arrays import FloatArray, Image
from synth.errors import InputError
from synth.mesh import rest_surface
from synth.pipeline.records import JobContext, SimulatedTrajectory
from synth.render.measured_light import read_measured_light
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.sampling import draw
from synth.scene import PadGel, Scene
from synth.surface import GelSurface

SUBDIVISIONS = {False: 4, True: 3}
"""Parts of a contact face's edge in the rendered surface; True: of a quadratic element's."""
FINER_DOME = 2
"""Factor on that for domes, which are curved away from the contact, too, where faces are large."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered state: vertex positions (v, 3) mm, and radiance by camera ("" is the main one)."""

    positions: FloatArray
    radiance: dict[str, Image]


@dataclass(frozen=True, eq=False)
class RenderedTrajectory:
    """A trajectory whose frames are rendered; picklable.

    `frames` are all that the wanted samples show, by number; `seconds` are those of rendering.
    """

    simulated: SimulatedTrajectory
    surface: GelSurface
    frames: Mapping[int, Frame]
    seconds: float


@dataclass(frozen=True, eq=False)
class SensorRenderer:
    """What all trajectories of one sensor share: its number, the renderer of its cameras, and the gel at rest.

    `rest` is the undeformed gel's radiance by camera; None for a dome, whose triangles are each trajectory's.
    """

    sensor: int
    renderer: Renderer
    rest: dict[str, Image] | None


class RenderSession:
    """Renders trajectories; keeps the last sensor's renderer and the last mesh's surface."""

    def __init__(self, context: JobContext) -> None:
        self._context = context
        self._sensor: SensorRenderer | None = None
        self._surface: tuple[tuple[object, ...], GelSurface] | None = None

    def warm_up(self) -> None:
        """Have kernels compiled, by the picture of the first sensor at rest, if its gel is flat."""
        if not self._context.plan.template.outputs.images:
            return
        with suppress(InputError):  # a job whose first sensor cannot be drawn or rendered says so in its turn
            scene = draw(self._context.plan.template, self._context.job.seed, 0)
            if scene.sensor.gel.shape == "box":
                self._prepared(scene, 0, rest_surface(scene.sensor.gel))

    def render_frames(self, simulated: SimulatedTrajectory) -> RenderedTrajectory:
        """Render the frames of a trajectory that its wanted samples show; without images they have no radiance."""
        started = time.perf_counter()
        surface = self._surface_of(simulated)
        if not self._context.plan.template.outputs.images:
            placed = {n: Frame(surface.positions(state.displacement), {}) for n, state in simulated.states.items()}
            return RenderedTrajectory(simulated, surface, placed, time.perf_counter() - started)
        sensor = self._prepared(simulated.scene, simulated.sensor, surface)
        frames: dict[int, Frame] = {}
        for number, state in sorted(simulated.states.items()):
            if number == 0 and sensor.rest is not None:
                frames[0] = Frame(surface.material, sensor.rest)
                continue
            positions = surface.positions(state.displacement)
            sensor.renderer.take(surface)
            seed = self._seed("frame", simulated.number, number)
            frames[number] = Frame(positions, sensor.renderer.radiances(positions, seed))
        return RenderedTrajectory(simulated, surface, frames, time.perf_counter() - started)

    def _surface_of(self, simulated: SimulatedTrajectory) -> GelSurface:
        gel = simulated.scene.sensor.gel
        key = *simulated.mesh.values(), gel.dome_radius_mm
        if self._surface is None or self._surface[0] != key:
            parts = SUBDIVISIONS[simulated.faces.is_quadratic] * (FINER_DOME if gel.dome_radius_mm else 1)
            self._surface = key, GelSurface(simulated.faces, parts)
        return self._surface[1]

    def _prepared(self, scene: Scene, number: int, meshed: GelSurface) -> SensorRenderer:
        """Renderer and undeformed frame of a sensor, kept until another one is wanted.

        `meshed` is a trajectory's surface; round gels have the same in all trajectories.
        """
        if self._sensor is None or self._sensor.sensor != number:
            variant = self._context.plan.variant
            variant.load()
            sensor = scene.sensor
            folder = self._context.plan.template.folder
            painted = albedo(sensor, self._context.stream("pattern", number), folder)
            measured = read_measured_light(sensor, folder)
            surface = rest_surface(sensor.gel) if isinstance(sensor.gel, PadGel) else meshed
            renderer = self._sensor.renderer if self._sensor else None
            if renderer is None or not renderer.reuse(sensor, scene.render, surface, painted, measured):
                renderer = Renderer(sensor, scene.render, surface, painted, variant, measured)
            seed = self._seed("rest", number)
            rest = None if sensor.gel.dome_radius_mm else renderer.radiances(surface.material, seed)
            self._sensor = SensorRenderer(number, renderer, rest)
        return self._sensor

    def _seed(self, purpose: str, *numbers: int) -> int:
        return int(self._context.stream(f"render {purpose}", *numbers).integers(2**31))
