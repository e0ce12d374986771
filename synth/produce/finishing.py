"""From a trajectory's rendered frames to its samples on disk: exact flow, the cameras' noise, encoding, writing.

All of it is the processor's work (0.6 s of one core for a pair of 640 x 480), and none of it needs the renderer: it may
be done in another process than the one that has the GPU.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import Image
from synth.dataset.images import Raster
from synth.dataset.sample import CameraPair, Sample
from synth.dataset.sample_files import write_sample_files
from synth.flow.exact import exact_flow
from synth.flow.field import FlowField
from synth.flow.view import View
from synth.optics import Optics
from synth.produce.records import FaceState, Failure, Outcome, Workplace
from synth.produce.studio import Frame
from synth.render.camera_image import camera_image
from synth.sampling import Pair, stream
from synth.scene import Camera, Scene
from synth.simulate.shared import Accuracy, accuracy
from synth.surface import GelSurface


@dataclass(frozen=True, eq=False)
class Developed:
    """A trajectory whose frames are rendered; picklable.

    Attributes:
        trajectory: its number.
        scene: its draw.
        surface: what was rendered.
        pairs: the samples to be made.
        states, frames: by frame number, all that the pairs show.
        mesh: its hash.
        element: its name.
        edge_radius_mm: of a mesh indenter's edges, else None.
        accuracy: of the mesh for this draw; None where it is left to whoever finishes the samples.
        failures: draws that failed before this one.
        seconds: wall time of the stages so far, per pair.
    """

    trajectory: int
    scene: Scene
    surface: GelSurface
    pairs: tuple[Pair, ...]
    states: Mapping[int, FaceState]
    frames: Mapping[int, Frame]
    mesh: str
    element: str
    edge_radius_mm: float | None
    accuracy: Accuracy | None
    failures: tuple[Failure, ...]
    seconds: Mapping[str, float]


def finish(place: Workplace, developed: Developed) -> Outcome:
    """Write a trajectory's samples.

    Raises:
        InputError: the storage refuses.
    """
    diagnostics = _diagnostics(developed, place.template.source.parent)
    looks = {
        name: View(developed.surface, Optics.of(view), view.camera.width, view.camera.height)
        for name, view in developed.scene.sensor.views.items()
    }
    entries = []
    for pair in developed.pairs:
        started = time.perf_counter()
        sample = _sample(place, developed, pair, diagnostics, looks)
        traced = time.perf_counter()
        entry = write_sample_files(place.out, sample, place.job)
        seconds = {**developed.seconds, "flow": traced - started, "write": time.perf_counter() - traced}
        entries.append(replace(entry, seconds={stage: round(value, 4) for stage, value in seconds.items()}))
    return Outcome(tuple(entries), developed.failures, ())


def _diagnostics(developed: Developed, folder: Path) -> dict[str, Any]:
    """What is said of the mesh."""
    rounded = {} if developed.edge_radius_mm is None else {"edge_radius_mm": round(developed.edge_radius_mm, 4)}
    found = developed.accuracy or accuracy(developed.scene, folder)
    return {
        "mesh": developed.mesh,
        "element": developed.element,
        "elements_across_contact": found.across,
        "predicted_error_px": None if np.isnan(found.error_px) else round(found.error_px, 4),
        **rounded,
    }


def _sample(
    place: Workplace, developed: Developed, pair: Pair, diagnostics: Mapping[str, Any], looks: Mapping[str, View]
) -> Sample:
    """`looks` are the trajectory's cameras by name."""
    scene, surface = developed.scene, developed.surface
    first, second = (developed.states[frame] for frame in pair.frames)
    frames = [developed.frames[frame] for frame in pair.frames]
    views = {}
    for k, (name, view) in enumerate(scene.sensor.views.items()):
        own = (k,) if k else ()  # of each further camera's noise
        images = [
            _photograph(place, view.camera, frame.radiance[name], (pair.index, number, *own))
            for number, frame in enumerate(frames)
        ]
        flow = _flow(scene, looks[name], frames, second)
        views[name] = CameraPair(images[0], images[1], flow)
    main = views.pop("")
    return Sample(
        index=pair.index,
        trajectory=pair.trajectory,
        frames=pair.frames,
        seed=place.job.seed,
        image1=main.image1,
        image2=main.image2,
        flow=main.flow,
        scene=scene,
        surface=surface,
        displacement1=first.displacement,
        displacement2=second.displacement,
        diagnostics={"solver": [first.summary, second.summary], **diagnostics},
        force_n=np.array([first.force_n, second.force_n]),
        torque_nmm=np.array([first.torque_nmm, second.torque_nmm]),
        further=views,
    )


def _photograph(place: Workplace, camera: Camera, radiance: Image, numbers: tuple[int, ...]) -> Raster:
    """What a camera makes of a frame, with noise of its own for every image; grey where the variant is."""
    rng = stream(place.template, place.job.seed, "noise", *numbers)
    if place.variant.is_mono:
        return camera_image(radiance[:, :, :1], camera, rng)[:, :, 0]
    return camera_image(radiance, camera, rng)


def _flow(scene: Scene, view: View, frames: list[Frame], pressed: FaceState) -> FlowField:
    """The exact flow between two frames, with what else the scene's outputs ask for; `pressed` is the second state."""
    outputs, surface = scene.outputs, view.surface
    traction = surface.interpolate_linear(pressed.traction) if outputs.traction else None
    touching = (np.linalg.norm(pressed.traction, axis=1, keepdims=True) > 0).astype(np.float64)
    return exact_flow(
        surface,
        frames[0].positions,
        frames[1].positions,
        view.optics,
        view.width,
        view.height,
        backward=outputs.backward,
        depth=outputs.depth,
        normal=outputs.normal,
        displacement=outputs.displacement,
        traction=traction,
        contact=surface.interpolate_linear(touching)[:, 0] if outputs.contact else None,
        view=view,
    )
