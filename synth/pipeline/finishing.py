"""From a trajectory's rendered frames to its samples on disk: exact flow, the cameras' noise, encoding, writing.

All of it is the processor's work, and none of it needs the renderer: it may be done in another process than the one
that has the GPU.
"""

import time
from collections.abc import Mapping
from dataclasses import replace
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
from synth.pipeline.records import JobContext, Outcome, SimulatedTrajectory
from synth.pipeline.render_session import Frame, RenderedTrajectory
from synth.render.camera_image import camera_image
from synth.render.exposure import advice, levels_of
from synth.render.rest_map import read_rest_map
from synth.scene import Camera, MeshIndenter, Outputs
from synth.scene.sampling import Pair
from synth.simulate import State
from synth.simulate.contact_patch import ContactPatch
from synth.simulate.press import as_pressed
from synth.simulate.resolution import accuracy

LEAST_GEL = 0.5
"""Share of pixels that show gel, below which images are warned of."""


def finish(context: JobContext, rendered: RenderedTrajectory) -> Outcome:
    """Write a trajectory's samples; InputError where the storage refuses."""
    simulated = rendered.simulated
    diagnostics = _diagnostics(context, simulated)
    sensors = simulated.scene.sensor.views
    device = "cuda" if context.plan.variant.is_on_gpu else "cpu"
    views = {name: View(rendered.surface, Optics.of(sensor), device) for name, sensor in sensors.items()}
    count, entries, warning = len(simulated.pairs), [], ""
    shared = {"simulate": simulated.seconds / count, "render": rendered.seconds / count}
    for pair in simulated.pairs:
        started = time.perf_counter()
        sample = _sample(context, rendered, pair, diagnostics, views)
        traced = time.perf_counter()
        if pair is simulated.pairs[0]:
            warning = _warning(context, sample, rendered.frames[pair.frames[0]].radiance[""])
        entry = write_sample_files(context.out, sample, context.job)
        seconds = {**shared, "flow": traced - started, "write": time.perf_counter() - traced}
        entries.append(replace(entry, seconds={stage: round(value, 4) for stage, value in seconds.items()}))
    return Outcome(tuple(entries), simulated.failures, (), tuple(filter(None, (simulated.warning, warning))))


def _warning(context: JobContext, sample: Sample, radiance: Image) -> str:
    """What makes a sample's images useless: little gel in them, or light that is clipped, dark or flat; or empty."""
    gel = np.isfinite(sample.flow.forward[:, :, 0])
    if (share := gel.mean()) < LEAST_GEL:
        return f"images show gel in {100 * share:.0f} % of their pixels only: check fx, fy and place of sensor.camera"
    camera = sample.scene.sensor.camera
    rest_map = read_rest_map(camera, context.plan.template.folder)
    found = advice(levels_of(sample.image1, gel), radiance, gel, camera, rest_map)
    return f"light is {found} (see `python -m synth preview`)" if found else ""


def _diagnostics(context: JobContext, simulated: SimulatedTrajectory) -> dict[str, Any]:
    found = simulated.accuracy or accuracy(simulated.scene, context.plan.template.folder)
    error = None if np.isnan(found.error_px) else round(found.error_px, 4)
    radius, is_mesh = simulated.path.body.fillet_mm, isinstance(simulated.scene.contact.indenter, MeshIndenter)
    more: dict[str, Any] = {"edge_radius_mm": round(radius, 4)} if is_mesh else {}
    if (frame := simulated.path.frame) is not None:
        more["inward_normal"] = frame.axes[:, 2].round(6).tolist()
    return {**simulated.mesh, "elements_across_contact": found.across, "predicted_error_px": error, **more}


def _sample(
    context: JobContext,
    rendered: RenderedTrajectory,
    pair: Pair,
    diagnostics: Mapping[str, Any],
    views: Mapping[str, View],
) -> Sample:
    """`views` are the trajectory's cameras by name."""
    simulated = rendered.simulated
    scene, path = simulated.scene, simulated.path
    first, second = states = [simulated.states[frame] for frame in pair.frames]
    solver, patch = [state.summary() for state in states], None
    if scene.outputs.contact:
        for state, frame, summary in zip(states, pair.frames, solver, strict=True):
            patch = ContactPatch.of(simulated.faces, state.displacement, path, frame, state.max_penetration_mm)
            summary["contact_area_mm2"] = patch.area_mm2
    frames = [rendered.frames[frame] for frame in pair.frames]
    cameras = {}
    for k, (name, sensor) in enumerate(scene.sensor.views.items()):
        own = (k,) if k else ()  # of each further camera's noise
        image1, image2 = (
            expose(context, sensor.camera, frame.radiance[name], (pair.index, number, *own))
            for number, frame in enumerate(frames)
        )
        cameras[name] = CameraPair(image1, image2, _flow(scene.outputs, views[name], frames, second, patch))
    main = cameras.pop("")
    return Sample(
        index=pair.index,
        trajectory=pair.trajectory,
        frames=pair.frames,
        seed=context.job.seed,
        **vars(main),
        scene=as_pressed(scene, path.body),
        surface=rendered.surface,
        displacement1=first.displacement,
        displacement2=second.displacement,
        diagnostics={"solver": solver, **diagnostics},
        force_n=np.array([first.force_n, second.force_n]),
        torque_nmm=np.array([first.torque_nmm, second.torque_nmm]),
        further=cameras,
    )


def expose(context: JobContext, camera: Camera, radiance: Image, numbers: tuple[int, ...]) -> Raster:
    """What a camera makes of a frame, with noise of its own for every image; grey where the variant is."""
    rng = context.stream("noise", *numbers)
    if context.plan.variant.is_mono:
        return camera_image(radiance[:, :, :1], camera, rng)[:, :, 0]
    return camera_image(radiance, camera, rng, read_rest_map(camera, context.plan.template.folder))


def _flow(outputs: Outputs, view: View, frames: list[Frame], pressed: State, patch: ContactPatch | None) -> FlowField:
    """The exact flow between two frames, with what else the outputs ask for; `pressed` is the second state."""
    surface = view.surface
    traction = surface.interpolate_linear(pressed.traction) if outputs.traction else None
    return exact_flow(
        view,
        frames[0].positions,
        frames[1].positions,
        **outputs.model_dump(include={"backward", "depth", "normal", "displacement"}),
        traction=traction,
        contact=patch.holds if patch else None,
    )
