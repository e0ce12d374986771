"""Radiance of a trajectory's frames: one renderer, kept until another sensor is wanted.

Nothing here depends on which other trajectories were rendered before: renderer and undeformed frame are a pure function
of (scene, seed, sensor), and every frame has a seed of its own.
"""

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass

from synth.arrays import FloatArray, Image
from synth.mesh import rest_surface
from synth.pipeline.records import Workplace
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.scene import Scene, Sensor
from synth.scene.sampling import stream
from synth.simulate.space import Space
from synth.surface import GelSurface

SUBDIVISIONS = {1: 4, 2: 3}
"""Parts of a contact face's edge in the rendered surface, by the element's order."""
FINER_DOME = 2
"""Factor on that for domes, which are curved away from the contact, too, where faces are large."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered state: vertex positions (v, 3) mm, and radiance by camera ("" is the main one)."""

    positions: FloatArray
    radiance: dict[str, Image]


@dataclass(frozen=True, eq=False)
class _Finger:
    """What all trajectories of one sensor share.

    Attributes:
        sensor: its number.
        renderer: of all its cameras.
        rest: radiance of the undeformed gel, by camera; None for a dome, whose triangles are each trajectory's.
    """

    sensor: int
    renderer: Renderer
    rest: dict[str, Image] | None


class Studio:
    """Renders trajectories; keeps the last sensor's renderer and the last mesh's surface."""

    def __init__(self, place: Workplace) -> None:
        """Nothing is loaded before the first frame."""
        self._place = place
        self._finger: _Finger | None = None
        self._surface: tuple[Space, GelSurface] | None = None

    def surface_of(self, scene: Scene, space: Space) -> GelSurface:
        """The surface that is rendered for a mesh."""
        if self._surface is None or self._surface[0] is not space:
            parts = SUBDIVISIONS[space.element.order] * (FINER_DOME if scene.sensor.gel.dome_radius_mm else 1)
            self._surface = space, GelSurface(space.surface, parts)
        return self._surface[1]

    def frames(
        self,
        scene: Scene,
        trajectory: int,
        sensor: int,
        surface: GelSurface,
        displacements: Mapping[int, FloatArray],
        texture: Future[Image] | None = None,
    ) -> dict[int, Frame]:
        """Frames of a trajectory by their number.

        Args:
            scene: its draw.
            trajectory: its number.
            sensor: its sensor's number.
            surface: from `surface_of`.
            displacements: (s, 3) mm at the surface's nodes, by number of the frame.
            texture: the sensor's, where it is being painted already; needed when the sensor changes.
        """
        finger = self._prepared(scene, sensor, texture)
        found: dict[int, Frame] = {}
        for frame in sorted(displacements):
            if frame == 0 and finger.rest is not None:
                found[0] = Frame(surface.material, finger.rest)
                continue
            positions = surface.positions(displacements[frame])
            finger.renderer.take(surface)
            seed = self._seed("frame", trajectory, frame)
            found[frame] = Frame(positions, finger.renderer.radiances(positions, seed))
        return found

    def _prepared(self, scene: Scene, sensor: int, texture: Future[Image] | None) -> _Finger:
        """Renderer and undeformed frame of a sensor, kept until another one is wanted."""
        if self._finger is None or self._finger.sensor != sensor:
            variant = self._place.variant
            variant.load()
            surface = rest_surface(scene.sensor.gel)
            painted = paint(self._place, sensor, scene.sensor) if texture is None else texture.result()
            renderer = Renderer(scene.sensor, scene.render, surface, painted, variant)
            rest = None
            if scene.sensor.gel.dome_radius_mm is None:
                rest = renderer.radiances(surface.material, self._seed("rest", sensor))
            self._finger = _Finger(sensor, renderer, rest)
        return self._finger

    def _seed(self, purpose: str, *numbers: int) -> int:
        return int(stream(self._place.template, self._place.job.seed, f"render {purpose}", *numbers).integers(2**31))


def paint(place: Workplace, sensor: int, scene: Sensor) -> Image:
    """A sensor's texture."""
    rng = stream(place.template, place.job.seed, "pattern", sensor)
    return albedo(scene, rng, place.template.source.parent)
