"""One trajectory's samples: draw, mesh, simulate, render, flow, files. What a worker does, in whatever process.

Nothing here depends on which other trajectories the process has made: what is kept between them (mesh, renderer, the
undeformed frame of a sensor) is a pure function of (scene, seed, sensor).
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Image
from synth.dataset.job import Job
from synth.dataset.sample import ManifestEntry, Sample
from synth.dataset.sample_files import write_sample_files
from synth.errors import InputError
from synth.flow.exact import exact_flow
from synth.flow.field import FlowField
from synth.mesh import PadMesh, pad_mesh
from synth.optics import Optics
from synth.render.camera_image import camera_image
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.variant import Variant
from synth.sampling import Pair, draw, pairs_of, stream
from synth.scene import Scene
from synth.simulate import State, Trajectory, simulate
from synth.surface import GelSurface
from synth.template import Template

MAX_DRAWS = 10
"""A trajectory whose simulation failed is drawn anew so often before its samples are given up."""


@dataclass(frozen=True)
class Workplace:
    """What every task of a job shares; picklable.

    Attributes:
        template: the scene.
        job: what the dataset was asked for.
        directory: of the dataset.
        variant: that renders.
        mesh_folders: where meshes are kept, the dataset's first.
        threads: for rendering; None for all cores.
    """

    template: Template
    job: Job
    directory: Path
    variant: Variant
    mesh_folders: tuple[Path, ...]
    threads: int | None = None


@dataclass(frozen=True)
class Failure:
    """A draw that gave no trajectory."""

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


class Producer:
    """Makes trajectories' samples; keeps the last sensor's renderer."""

    def __init__(self, workplace: Workplace) -> None:
        self._place = workplace
        self._sensor: int | None = None

    def produce(self, trajectory: int, wanted: Sequence[int]) -> Outcome:
        """Write the wanted samples of a trajectory.

        Args:
            trajectory: its number.
            wanted: indices of the samples that are not there yet.
        """
        failures: list[Failure] = []
        template, seed = self._place.template, self._place.job.seed
        count = template.corners[0].sampling.pairs_per_trajectory
        for attempt in range(MAX_DRAWS):
            stage = "draw"
            try:
                scene = draw(template, seed, trajectory, attempt)
                stage = "simulate"
                mesh = pad_mesh(scene.sensor.gel, scene.numerics, self._place.mesh_folders)
                result = simulate(scene, mesh, template.source.parent)
            except InputError as error:
                failures.append(Failure(trajectory * count, attempt, stage, str(error), None))
                continue
            if result.status == "complete":
                pairs = [p for p in pairs_of(template, seed, trajectory, scene.motion.steps) if p.index in wanted]
                return Outcome(tuple(self._samples(scene, mesh, result, pairs)), tuple(failures), ())
            last = result.states[-1].summary()
            failures.append(Failure(trajectory * count, attempt, stage, result.reason, last))
        return Outcome((), tuple(failures), tuple(wanted))

    def _samples(self, scene: Scene, mesh: PadMesh, result: Trajectory, pairs: Sequence[Pair]) -> list[ManifestEntry]:
        self._prepare(scene, mesh, pairs[0].sensor)
        frames: dict[int, tuple[FloatArray, Image, float]] = {}
        entries = []
        for pair in pairs:
            for frame in pair.frames:
                if frame not in frames:
                    frames[frame] = self._frame(mesh, result.states[frame], pair, frame)
            sample = self._sample(scene, mesh, result, pair, frames, len(pairs))
            started = time.perf_counter()
            entry = write_sample_files(self._place.directory, sample, self._place.job)
            seconds = {**entry.seconds, "write": round(time.perf_counter() - started, 4)}
            entries.append(ManifestEntry(**{**entry.record(), "seconds": seconds}))
        return entries

    def _prepare(self, scene: Scene, mesh: PadMesh, sensor: int) -> None:
        """Renderer, camera and undeformed frame of a sensor, unless they are there already."""
        if self._sensor == sensor:
            return
        template, seed = self._place.template, self._place.job.seed
        variant = self._place.variant
        variant.load()
        if self._place.threads is not None and variant.is_vectorised:
            import drjit

            drjit.set_thread_count(self._place.threads)
        self._surface = GelSurface(mesh.contact_faces)
        self._optics = Optics.of(scene.sensor)
        texture = albedo(scene.sensor, stream(template, seed, "pattern", sensor))
        self._renderer = Renderer(scene.sensor, scene.render, self._surface, texture, variant)
        started = time.perf_counter()
        rest = self._surface.material
        self._rest = (
            rest,
            self._renderer.radiance(rest, self._frame_seed("rest", sensor)),
            time.perf_counter() - started,
        )
        self._sensor = sensor

    def _frame_seed(self, purpose: str, *numbers: int) -> int:
        return int(stream(self._place.template, self._place.job.seed, f"render {purpose}", *numbers).integers(2**31))

    def _frame(self, mesh: PadMesh, state: State, pair: Pair, frame: int) -> tuple[FloatArray, Image, float]:
        """Positions, radiance and render time of one state."""
        if frame == 0:
            return self._rest
        started = time.perf_counter()
        positions = self._surface.positions(state.displacement[mesh.contact_nodes])
        radiance = self._renderer.radiance(positions, self._frame_seed("frame", pair.trajectory, frame))
        return positions, radiance, time.perf_counter() - started

    def _sample(
        self,
        scene: Scene,
        mesh: PadMesh,
        result: Trajectory,
        pair: Pair,
        frames: dict[int, tuple[FloatArray, Image, float]],
        sharing: int,
    ) -> Sample:
        """One sample; the trajectory's simulation is shared by `sharing` samples."""
        first, second = (result.states[frame] for frame in pair.frames)
        started = time.perf_counter()
        flow = self._flow(scene, frames[pair.frames[0]][0], frames[pair.frames[1]][0], second)
        traced = time.perf_counter() - started
        images = [
            self._photograph(scene, frames[frame][1], pair.index, number) for number, frame in enumerate(pair.frames)
        ]
        return Sample(
            index=pair.index,
            trajectory=pair.trajectory,
            frames=pair.frames,
            seed=self._place.job.seed,
            image1=images[0],
            image2=images[1],
            flow=flow,
            scene=scene,
            surface=self._surface,
            displacement1=first.displacement[mesh.contact_nodes],
            displacement2=second.displacement[mesh.contact_nodes],
            diagnostics={"solver": [first.summary(), second.summary()], "mesh": mesh.hash},
            force_n=np.array([first.force_n, second.force_n]),
            torque_nmm=np.array([first.torque_nmm, second.torque_nmm]),
            seconds={
                "simulate": result.seconds / sharing,
                "render": sum(frames[frame][2] for frame in pair.frames),
                "flow": traced,
            },
        )

    def _flow(self, scene: Scene, positions1: FloatArray, positions2: FloatArray, pressed: State) -> FlowField:
        outputs, camera, surface = scene.outputs, scene.sensor.camera, self._surface
        traction = surface.interpolate_linear(pressed.traction) if outputs.traction else None
        touching = (np.linalg.norm(pressed.traction, axis=1, keepdims=True) > 0).astype(np.float64)
        return exact_flow(
            surface,
            positions1,
            positions2,
            self._optics,
            camera.width,
            camera.height,
            backward=outputs.backward,
            depth=outputs.depth,
            normal=outputs.normal,
            displacement=outputs.displacement,
            traction=traction,
            contact=surface.interpolate_linear(touching)[:, 0] if outputs.contact else None,
        )

    def _photograph(self, scene: Scene, radiance: Image, index: int, number: int) -> np.ndarray:
        """What the camera makes of a frame, with noise of its own for every image; grey where the variant is."""
        rng = stream(self._place.template, self._place.job.seed, "noise", index, number)
        if self._place.variant.is_mono:
            return camera_image(radiance[:, :, :1], scene.sensor.camera, rng)[:, :, 0]
        return camera_image(radiance, scene.sensor.camera, rng)
