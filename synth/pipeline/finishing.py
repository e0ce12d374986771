"""From a trajectory's rendered frames to its samples on disk: exact flow, the cameras' noise, encoding, writing.

All of it is the processor's work, and none of it needs the renderer: it may be done in another process than the one
that has the GPU.
"""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from synth.arrays import Image
from synth.dataset.images import Raster
from synth.dataset.sample import CameraFrames, Sample
from synth.dataset.sample_files import write_sample_files
from synth.flow.exact import exact_flow, since_before
from synth.flow.field import FlowField
from synth.flow.markers import tracks
from synth.flow.view import View
from synth.optics import Optics
from synth.pipeline.records import JobContext, Outcome, SimulatedTrajectory
from synth.pipeline.render_session import Frame, RenderedTrajectory
from synth.press.press import as_pressed
from synth.press.resolution import accuracy
from synth.render.camera_image import camera_image
from synth.render.chart import chart_of
from synth.render.exposure import advice, levels_of
from synth.render.pattern import dots_of
from synth.render.rest_map import read_rest_map
from synth.sampling import SampleFrames
from synth.scene import Camera, MeshIndenter, Outputs
from synth.simulate import State
from synth.simulate.contact_patch import ContactPatch

LEAST_GEL = 0.5
"""Share of pixels that show gel, below which images are warned of."""
LOOKED_AT = 64
"""Trajectories, from the first one on, whose images are looked at for a warning, which is given once."""


def load_kernels(device: str) -> None:
    """Load what finishing needs of Warp; on a new machine it is compiled."""
    wp.load_module("synth.press.measure", "cpu")
    wp.load_module("synth.flow.trace", device)


def finish(context: JobContext, rendered: RenderedTrajectory) -> Outcome:
    """Write a trajectory's samples; InputError where the storage refuses."""
    simulated = rendered.simulated
    diagnostics = _diagnostics(context, simulated)
    sensors = simulated.scene.sensor.views
    views = {name: View(rendered.surface, Optics.of(sensor), context.plan.device) for name, sensor in sensors.items()}
    count, entries, warning = len(simulated.samples), [], ""
    shared = {"simulate": simulated.seconds / count, "render": rendered.seconds / count}
    for shown in simulated.samples:
        started, tracing = time.perf_counter(), list[float]()
        sample = _sample(context, rendered, shown, diagnostics, views, tracing)
        if simulated.number < LOOKED_AT and shown is simulated.samples[0] and simulated.scene.outputs.images:
            warning = _warning(context, sample, views[""], rendered.frames[shown.frames[0]])
        entry = write_sample_files(context.out, sample, context.job)
        seconds = {**shared, "flow": sum(tracing), "write": time.perf_counter() - started - sum(tracing)}
        entries.append(replace(entry, seconds={stage: round(value, 4) for stage, value in seconds.items()}))
    return Outcome(tuple(entries), simulated.failures, (), tuple(filter(None, (simulated.warning, warning))))


@contextmanager
def _timed(spent: list[float]) -> Iterator[None]:
    """Puts the seconds of a block on a list."""
    started = time.perf_counter()
    yield
    spent.append(time.perf_counter() - started)


def _warning(context: JobContext, sample: Sample, view: View, frame: Frame) -> str:
    """What makes a sample's images useless: little gel in them, or light that is clipped, dark or flat; or empty."""
    gel = view.image(view.state(frame.positions).hits.triangle >= 0) > 0
    if (share := gel.mean()) < LEAST_GEL:
        return f"images show gel in {100 * share:.0f} % of their pixels only: check fx, fy and place of sensor.camera"
    camera = sample.scene.sensor.camera
    rest_map = read_rest_map(camera, context.plan.template.folder)
    found = advice(levels_of(sample.cameras[""].images[0], gel), frame.radiance[""], gel, camera, rest_map)
    return f"light is {found} (see `python -m synth preview`)" if found else ""


def _diagnostics(context: JobContext, simulated: SimulatedTrajectory) -> dict[str, Any]:
    found = simulated.accuracy or accuracy(simulated.scene, context.plan.template.folder)
    errors = {"predicted_error_px": found.error_px, "predicted_error_percent": found.error_percent}
    predicted = {name: None if np.isnan(error) else round(error, 4) for name, error in errors.items()}
    radius, is_mesh = simulated.path.body.fillet_mm, isinstance(simulated.scene.contact.indenter, MeshIndenter)
    more: dict[str, Any] = {"edge_radius_mm": round(radius, 4)} if is_mesh else {}
    if (frame := simulated.path.frame) is not None:
        more["inward_normal"] = frame.axes[:, 2].round(6).tolist()
    return {**simulated.mesh, "elements_across_contact": found.across, **predicted, **more}


def _sample(
    context: JobContext,
    rendered: RenderedTrajectory,
    shown: SampleFrames,
    diagnostics: Mapping[str, Any],
    views: Mapping[str, View],
    tracing: list[float],
) -> Sample:
    """`views` are the trajectory's cameras by name; the flow is traced, and timed, when it is written."""
    simulated = rendered.simulated
    scene, outputs, is_clip = simulated.scene, simulated.scene.outputs, simulated.scene.sampling.kind == "clips"
    states = [simulated.states[frame] for frame in shown.frames]
    solver, patches = [state.summary() for state in states], []
    if outputs.contact or is_clip:
        for state, number, summary in zip(states, shown.frames, solver, strict=True):
            nodal, deepest = state.displacement, state.max_penetration_mm
            patches.append(ContactPatch.of(simulated.faces, nodal, simulated.path, number, deepest))
            summary["contact_area_mm2"] = patches[-1].area_mm2
    frames = [rendered.frames[frame] for frame in shown.frames]
    dots = dots_of(scene.sensor, context.stream("pattern", shown.sensor)) if is_clip else np.zeros((0, 2))
    flattened = chart_of(scene.sensor).flattened(rendered.surface.material)
    cameras = {}
    for k, (name, sensor) in enumerate(scene.sensor.views.items()):
        own = (k,) if k else ()  # of each further camera's noise
        numbered = enumerate(frames) if outputs.images else ()
        flows = _flows(outputs, views[name], frames, states, patches, tracing)
        with _timed(tracing):
            images = tuple(
                expose(context, sensor.camera, frame.radiance[name], (shown.index, number, *own))
                for number, frame in numbered
            )
            markers = tracks(views[name], flattened, dots, [frame.positions for frame in frames])
        cameras[name] = CameraFrames((sensor.camera.height, sensor.camera.width), images, flows, markers)
    return Sample(
        index=shown.index,
        trajectory=shown.trajectory,
        frames=shown.frames,
        seed=context.job.seed,
        scene=as_pressed(scene, simulated.path.body),
        surface=rendered.surface,
        displacements=tuple(state.displacement for state in states),
        cameras=cameras,
        diagnostics={"solver": solver, **diagnostics},
        force_n=np.array([state.force_n for state in states]),
        torque_nmm=np.array([state.torque_nmm for state in states]),
    )


def expose(context: JobContext, camera: Camera, radiance: Image, numbers: tuple[int, ...]) -> Raster:
    """What a camera makes of a frame, with noise of its own for every image; grey where the variant is."""
    rng = context.stream("noise", *numbers)
    if context.plan.variant.is_mono:
        return camera_image(radiance[:, :, :1], camera, rng)[:, :, 0]
    return camera_image(radiance, camera, rng, read_rest_map(camera, context.plan.template.folder))


def _flows(
    outputs: Outputs,
    view: View,
    frames: Sequence[Frame],
    states: Sequence[State],
    patches: Sequence[ContactPatch],
    tracing: list[float],
) -> Iterator[FlowField]:
    """The exact flow from the first frame to each other, with what else the outputs ask for."""
    surface, places = view.surface, [frame.positions for frame in frames]
    for k in range(1, len(frames)):
        with _timed(tracing):
            flow = exact_flow(
                view,
                places[0],
                places[k],
                **outputs.model_dump(include={"backward", "depth", "normal", "displacement"}),
                traction=surface.interpolate_linear(states[k].traction) if outputs.traction else None,
                contact=patches[k].holds if outputs.contact else None,
            )
            slip = partial(patches[k].slip, patches[k - 1]) if outputs.slip else None
            more = since_before(view, places[0], places[k - 1], places[k], previous=outputs.previous, slip=slip)
            flow = replace(flow, extras={**flow.extras, **more})
        yield flow
