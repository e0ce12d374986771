"""One trajectory's samples: draw, mesh, simulate, render, flow, files. What a worker does, in whatever process.

Nothing here depends on which other trajectories the process has made: what is kept between them (mesh, renderer, the
undeformed frame of a sensor) is a pure function of (scene, seed, sensor).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Image
from synth.dataset.images import Raster
from synth.dataset.job import Job
from synth.dataset.output import Output, mesh_folder, write_sample
from synth.dataset.sample import CameraPair, ManifestEntry, Sample
from synth.errors import InputError
from synth.flow.exact import exact_flow
from synth.flow.field import FlowField
from synth.mesh import flat_surface as flat_surface
from synth.mesh import rest_surface
from synth.optics import Optics
from synth.render.camera_image import camera_image
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.variant import Variant
from synth.sampling import MAX_DRAWS, Pair, draw, draw_sensor, pairs_of, sensor_of, stream
from synth.scene import Camera, Scene
from synth.simulate import State, Trajectory, simulate
from synth.simulate.resolution import Resolution, resolve
from synth.surface import GelSurface
from synth.template import Template

SUBDIVISIONS = {1: 4, 2: 3}
"""Parts of a contact face's edge in the rendered surface, by the element's order."""
FINER_DOME = 2
"""Factor on that for domes, which are curved away from the contact, too, where faces are large."""

Task = tuple[int, tuple[int, ...]]
"""A trajectory and its samples that are wanted."""


@dataclass(frozen=True)
class Workplace:
    """What every task of a job shares; picklable.

    Attributes:
        template: the scene.
        job: what the dataset was asked for.
        out: of the dataset.
        variant: that renders.
        cache: where meshes are kept beside the dataset.
        threads: for rendering; None for all cores.
    """

    template: Template
    job: Job
    out: Output
    variant: Variant
    cache: Path
    threads: int | None = None

    @property
    def needs_meshes(self) -> bool:
        """Whether pads are meshed by fTetWild, which is random, so that all must use the same mesh."""
        return self.template.corners[0].numerics.edge_length_mm is not None


@dataclass(frozen=True)
class Failure:
    """A draw that gave no trajectory.

    Attributes:
        index: of the trajectory's first sample.
        draw: 0 for the trajectory's first failed draw, and so on.
        stage: "sensor", "draw" or "simulate".
        reason: for the user.
        last_good_state: of a simulation.
    """

    index: int
    draw: int
    stage: str
    reason: str
    last_good_state: dict[str, Any] | None


@dataclass(frozen=True)
class Outcome:
    """What a task did: manifest lines of the samples on disk, failed draws, and samples given up."""

    entries: tuple[ManifestEntry, ...]
    failures: tuple[Failure, ...]
    given_up: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class _Finger:
    """What all trajectories of one sensor share, by camera ("" is the main one) where there may be several.

    Attributes:
        sensor: its number.
        optics: of each camera.
        renderer: of all of them.
        rest: radiance of the undeformed gel in each camera; empty for a dome, whose triangles are each trajectory's.
    """

    sensor: int
    optics: dict[str, Optics]
    renderer: Renderer
    rest: dict[str, Image]


@dataclass(frozen=True, eq=False)
class _Frame:
    """A rendered state: vertex positions (v, 3) mm, and radiance by camera."""

    positions: FloatArray
    radiance: dict[str, Image]


class Producer:
    """Makes trajectories' samples; keeps the last sensor's renderer."""

    def __init__(self, workplace: Workplace) -> None:
        self._place = workplace
        self._finger: _Finger | None = None

    def produce(self, trajectory: int, wanted: Sequence[int]) -> Outcome:
        """Write the wanted samples of a trajectory.

        Args:
            trajectory: its number.
            wanted: indices of the samples that are not there yet.

        Raises:
            InputError: the storage refuses.
        """
        template, seed = self._place.template, self._place.job.seed
        first = trajectory * template.corners[0].sampling.pairs_per_trajectory
        sensor = draw_sensor(template, seed, sensor_of(template, trajectory))
        meshes = (mesh_folder(self._place.out), self._place.cache) if self._place.needs_meshes else None
        failures = [Failure(first, number, "sensor", reason, None) for number, reason in enumerate(sensor.rejected)]
        for attempt in range(MAX_DRAWS if sensor.content is not None else 0):
            stage = "draw"
            try:
                scene = draw(template, seed, trajectory, attempt, sensor)
                stage = "simulate"
                resolution = resolve(scene, template.source.parent, meshes)
                every = pairs_of(template, seed, trajectory, scene.motion.steps)
                frames = frozenset(frame for pair in every for frame in pair.frames)
                result = simulate(scene, resolution.mesh, template.source.parent, frames=frames)
            except InputError as error:
                failures.append(Failure(first, len(failures), stage, str(error), None))
                continue
            if result.status == "complete":
                pairs = [pair for pair in every if pair.index in wanted]
                return Outcome(tuple(self._samples(scene, resolution, result, pairs)), tuple(failures), ())
            failures.append(Failure(first, len(failures), stage, result.reason, result.states[-1].summary()))
        return Outcome((), tuple(failures), tuple(wanted))

    def _samples(
        self, scene: Scene, resolution: Resolution, result: Trajectory, pairs: Sequence[Pair]
    ) -> list[ManifestEntry]:
        parts = SUBDIVISIONS[result.space.element.order] * (FINER_DOME if scene.sensor.gel.dome_radius_mm else 1)
        surface = GelSurface(result.space.surface, parts)
        frames: dict[int, _Frame] = {}
        entries = []
        for pair in pairs:
            started = time.perf_counter()
            finger = self._prepared(scene, pair.sensor)
            for frame in pair.frames:
                if frame not in frames:
                    frames[frame] = self._rendered(finger, surface, result, pair.trajectory, frame)
            rendered = time.perf_counter()
            sample = self._sample(scene, resolution, result, pair, finger, surface, [frames[k] for k in pair.frames])
            traced = time.perf_counter()
            entry = write_sample(self._place.out, sample, self._place.job)
            seconds = {
                "simulate": result.seconds / len(pairs),
                "render": rendered - started,
                "flow": traced - rendered,
                "write": time.perf_counter() - traced,
            }
            entries.append(replace(entry, seconds={stage: round(value, 4) for stage, value in seconds.items()}))
        return entries

    def _prepared(self, scene: Scene, sensor: int) -> _Finger:
        """Renderer, camera and undeformed frame of a sensor, kept until another one is wanted."""
        if self._finger is None or self._finger.sensor != sensor:
            variant = self._place.variant
            variant.load()
            if self._place.threads is not None and variant.is_vectorised:
                import drjit

                drjit.set_thread_count(self._place.threads)
            surface = rest_surface(scene.sensor.gel)
            template, seed = self._place.template, self._place.job.seed
            texture = albedo(scene.sensor, stream(template, seed, "pattern", sensor), template.source.parent)
            renderer = Renderer(scene.sensor, scene.render, surface, texture, variant)
            flat = scene.sensor.gel.dome_radius_mm is None
            rest = renderer.radiances(surface.material, self._frame_seed("rest", sensor)) if flat else {}
            optics = {name: Optics.of(view) for name, view in scene.sensor.views.items()}
            self._finger = _Finger(sensor, optics, renderer, rest)
        return self._finger

    def _frame_seed(self, purpose: str, *numbers: int) -> int:
        return int(stream(self._place.template, self._place.job.seed, f"render {purpose}", *numbers).integers(2**31))

    def _rendered(
        self, finger: _Finger, surface: GelSurface, result: Trajectory, trajectory: int, frame: int
    ) -> _Frame:
        if frame == 0 and finger.rest:
            return _Frame(surface.material, finger.rest)
        positions = surface.positions(result.states[frame].displacement[result.space.surface_nodes])
        finger.renderer.take(surface)
        return _Frame(positions, finger.renderer.radiances(positions, self._frame_seed("frame", trajectory, frame)))

    def _sample(
        self,
        scene: Scene,
        resolution: Resolution,
        result: Trajectory,
        pair: Pair,
        finger: _Finger,
        surface: GelSurface,
        frames: Sequence[_Frame],
    ) -> Sample:
        first, second = (result.states[frame] for frame in pair.frames)
        views = {}
        for k, (name, view) in enumerate(scene.sensor.views.items()):
            own = (k,) if k else ()  # of each further camera's noise
            images = [
                self._photograph(view.camera, frame.radiance[name], (pair.index, number, *own))
                for number, frame in enumerate(frames)
            ]
            flow = _flow(scene, view.camera, finger.optics[name], surface, frames, second)
            views[name] = CameraPair(images[0], images[1], flow)
        main = views.pop("")
        return Sample(
            index=pair.index,
            trajectory=pair.trajectory,
            frames=pair.frames,
            seed=self._place.job.seed,
            image1=main.image1,
            image2=main.image2,
            flow=main.flow,
            scene=scene,
            surface=surface,
            displacement1=first.displacement[result.space.surface_nodes],
            displacement2=second.displacement[result.space.surface_nodes],
            diagnostics={
                "solver": [first.summary(), second.summary()],
                "mesh": resolution.mesh.hash,
                "element": result.space.element.name,
                "elements_across_contact": resolution.across,
                "predicted_error_px": None if np.isnan(resolution.error_px) else round(resolution.error_px, 4),
            },
            force_n=np.array([first.force_n, second.force_n]),
            torque_nmm=np.array([first.torque_nmm, second.torque_nmm]),
            further=views,
        )

    def _photograph(self, camera: Camera, radiance: Image, numbers: tuple[int, ...]) -> Raster:
        """What a camera makes of a frame, with noise of its own for every image; grey where the variant is."""
        rng = stream(self._place.template, self._place.job.seed, "noise", *numbers)
        if self._place.variant.is_mono:
            return camera_image(radiance[:, :, :1], camera, rng)[:, :, 0]
        return camera_image(radiance, camera, rng)


def _flow(
    scene: Scene, camera: Camera, optics: Optics, surface: GelSurface, frames: Sequence[_Frame], pressed: State
) -> FlowField:
    """The exact flow between two frames, with what else the scene's outputs ask for; `pressed` is the second state."""
    outputs = scene.outputs
    traction = surface.interpolate_linear(pressed.traction) if outputs.traction else None
    touching = (np.linalg.norm(pressed.traction, axis=1, keepdims=True) > 0).astype(np.float64)
    return exact_flow(
        surface,
        frames[0].positions,
        frames[1].positions,
        optics,
        camera.width,
        camera.height,
        backward=outputs.backward,
        depth=outputs.depth,
        normal=outputs.normal,
        displacement=outputs.displacement,
        traction=traction,
        contact=surface.interpolate_linear(touching)[:, 0] if outputs.contact else None,
    )
