"""What a plan will cost, and how exact its simulation will be: predicted from the meshes of some random instances.

The costs are predictions from constants measured on one core of a 2-core x86-64 server; other machines differ by a
factor of two or three either way. Errors are predictions of `synth.press.resolution`. Choosing the meshes takes
seconds, so that `generate`, which needs none of this, does not ask for it.
"""

import contextlib
import math
from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.mesh import edge_length
from synth.mesh.layered import elements_through
from synth.planning.plan import Plan
from synth.press.press import edge_radius_mm
from synth.press.resolution import Resolution, resolution_mm
from synth.press.scene_path import path_of
from synth.sampling import draw
from synth.scene import CapsuleGel, FileGel, Gel, MeshIndenter, Scene, Vector3
from synth.simulate.solve import VICINITY

_Errors = tuple[float, float] | None
"""Median and largest."""
_Meshes = tuple[list[tuple[Scene, int]], str, _Errors, _Errors]
"""Random instances with their displacement nodes; `Prediction.resolution`, `error_px` and `error_percent`."""
INSTANCES = 12
"""Trajectories whose meshes are chosen to predict error and time."""
NODES_PER_VOLUME, NODES_PER_AREA, NODES_PER_CURVED_AREA, FEWEST_NODES = 0.72, 0.25, 2.3, 300
"""Vertices of fTetWild's meshes: in a cube, on a flat and on a curved square with the contact face's edge length for a
side; and in all, at least."""
VERTICES_TO_P2 = 7.0
"""Displacement nodes of P2 elements per vertex of the mesh."""
SOLVE_SECONDS = 0.06
"""Seconds of a Newton iteration (assembly, factorisation, solution) without friction, with SOLVE_NODES nodes."""
SOLVE_NODES = 5000
SOLVE_GROWTH = 1.25
"""Exponent of a solve's time in the nodes."""
FRICTION = 1.5
"""Time of an iteration with friction over one without."""
ITERATIONS_PER_STEP, ITERATIONS_PER_RECORD = 4.5, 7.0
MESH_INDENTER = 4.5
"""Time of a press by a mesh indenter over a ball's, in the mean: a few take far longer than the median."""
BATCHED_SECONDS = {"cuda": 5.5e-5, "cpu": 0.8}
"""Seconds of a Newton iteration of one trajectory by the batched solver, with BATCHED_NODES nodes; on a GPU among
hundreds of trajectories (docs/reports/batched_fem.md)."""
BATCHED_NODES = 3500
BATCHED_GROWTH = 1.6
"""Exponent of that in the number of nodes: the preconditioner is a dense matrix, the rest is linear."""
AUTO_SAMPLES = 64
"""What samples_per_pixel = "auto" counts for, before a sensor has been measured."""
SECONDS_PER_MILLION_SAMPLES = {"llvm": 0.4, "scalar": 1.0, "cuda": 0.002}
"""Seconds of path tracing a million camera samples, by the kind of variant."""
FLOW_SECONDS_PER_MEGAPIXEL = 1.0
BYTES_PER_PIXEL_OF_FLOW = 14.0
BYTES_PER_PIXEL_OF_IMAGE = 1.4
MEMORY_PER_FRAME = 12.0
"""Bytes a pixel of the radiance of each further frame of a clip."""
MEMORY, MEMORY_PER_SAMPLE, SAMPLES_AT_ONCE, MEMORY_PER_PIXEL, MEMORY_PER_NODE = 4e8, 70, 2**22, 290, 12e3
"""Bytes of a process that simulates and renders on a CPU; samples count up to those that are traced at once."""


@dataclass(frozen=True)
class Prediction:
    """Predictions for one plan.

    Attributes:
        resolution: how fine the meshes are, in words.
        warning: of detail that rounding takes off an object, see `MeshRule.lost_detail`.
        error_px: error of the flow from the simulation: median and largest of INSTANCES trajectories; None where the
            mesh is given by an edge length, for which nothing is predicted.
        target_error_px: what was asked for; None with an edge length.
        error_percent: the same, of force and displacement; None also for P1/P1 elements.
        target_error_percent: what was asked for.
        nodes: displacement nodes, mean of the trajectories.
        seconds_per_pair: by stage, on one core; of a clip where samples are clips.
        bytes_per_pair: size on disk; the same.
        memory_bytes: most memory of a process that simulates and renders on a CPU.
    """

    resolution: str
    warning: str
    error_px: _Errors
    target_error_px: float | None
    error_percent: _Errors
    target_error_percent: float | None
    nodes: int
    seconds_per_pair: dict[str, float]
    bytes_per_pair: int
    memory_bytes: int

    def error_lines(self) -> list[str]:
        """What can be said of the simulation's discretisation error: for each kind a line with its target, if any."""
        if self.error_px is None:
            return ["the simulation's discretisation error is not predicted for meshes of fTetWild"]
        flow = _error_line("the flow", "px", self.error_px, self.target_error_px)
        percent = self.error_percent
        if percent is None:
            return [flow]
        return [flow, _error_line("force and displacement", "%", percent, self.target_error_percent)]


def _error_line(what: str, unit: str, errors: tuple[float, float], target: float | None) -> str:
    values = f"{errors[0]:.2g} {unit} (median), {errors[1]:.2g} {unit} (largest)"
    line = f"predicted error of {what} from the simulation: {values}"
    if target is None:
        return line
    if errors[1] > target:
        return f"{line}; for some trajectories the mesh does not reach the target of {target:g} {unit}"
    return f"{line}; target {target:g} {unit}"


def predict(plan: Plan) -> Prediction:
    """Choose the meshes of the first trajectories as `generate` will; InputError if none can be drawn and meshed."""
    template, variant, outputs = plan.template, plan.variant, plan.template.outputs
    sampling, corner = template.sampling, template.corners[0]
    samples = sampling.samples_per_trajectory
    steps = float(np.mean([one.motion.steps for one in template.corners]))
    images, flows, pressed = (steps + 1, steps, steps) if sampling.kind == "clips" else (2.0, 1.0, _pressed(samples))
    rendered = (pressed + 1 / sampling.trajectories_per_sensor) / samples if outputs.images else 0.0
    cameras = [view.camera for view in corner.sensor.views.values()]
    meshes = _tetwild_meshes if plan.mesh.kind == "tetwild" else _meshes
    presses, resolution, error_px, error_percent = meshes(plan)
    simulate = float(np.mean([_simulation_seconds(scene, nodes, plan) for scene, nodes in presses]))
    pixels = sum(camera.width * camera.height for camera in cameras)
    rays = AUTO_SAMPLES if corner.render.samples_per_pixel == "auto" else corner.render.samples_per_pixel
    frame = pixels * rays / 1e6 * SECONDS_PER_MILLION_SAMPLES[variant.name.split("_")[0]]
    nodes = float(np.mean([count for _, count in presses]))
    memory = MEMORY + (MEMORY_PER_PIXEL + MEMORY_PER_FRAME * (images - 2)) * pixels + MEMORY_PER_NODE * nodes
    memory += MEMORY_PER_SAMPLE * min(SAMPLES_AT_ONCE, rays * max(one.width * one.height for one in cameras))
    directions = 1 + outputs.backward + outputs.previous
    flow_bytes = flows * BYTES_PER_PIXEL_OF_FLOW * directions / 2
    image_bytes = images * BYTES_PER_PIXEL_OF_IMAGE if outputs.images else 0.0
    return Prediction(
        resolution=resolution,
        warning=_lost_detail(plan),
        error_px=error_px,
        target_error_px=None if error_px is None else plan.mesh.target_error_px,
        error_percent=error_percent,
        target_error_percent=plan.mesh.target_error_percent,
        nodes=round(nodes),
        seconds_per_pair={
            "simulate": round(simulate / samples, 3),
            "render": round(frame * rendered, 3),
            "flow": round(flows * directions * pixels / 1e6 * FLOW_SECONDS_PER_MEGAPIXEL, 3),
        },
        bytes_per_pair=round(pixels * (flow_bytes + image_bytes)),
        memory_bytes=round(memory),
    )


def _pressed(pairs: int) -> int:
    """States that are rendered beside the undeformed one: k of them make k (k + 1) / 2 pairs."""
    return math.ceil((math.sqrt(1 + 8 * pairs) - 1) / 2)


def _lost_detail(plan: Plan) -> str:
    """The first warning of those that some instances give."""
    template, rule = plan.template, plan.mesh
    for trajectory in range(INSTANCES):
        with contextlib.suppress(InputError):
            scene = draw(template, 0, trajectory)
            indenter = scene.contact.indenter
            if isinstance(indenter, MeshIndenter) and indenter.fillet_mm is None:
                found = None if rule.kind == "tetwild" else rule.resolution(scene, template.folder)
                spacing = found.mesh.spacing_mm if found else edge_length(scene.sensor.gel, scene.numerics)
                body = path_of(scene, template.folder, resolution_mm(scene, spacing)).body
                return rule.lost_detail(scene, body, found)
    return ""


def _meshes(plan: Plan) -> _Meshes:
    template = plan.template
    found: list[tuple[Scene, Resolution]] = []
    reason = ""
    for trajectory in range(INSTANCES):
        try:
            scene = draw(template, 0, trajectory)
            resolution = plan.mesh.resolution(scene, template.folder)
            plan.mesh.check_edges(scene, resolution.mesh)
            found.append((scene, resolution))
        except InputError as error:  # impossible: generate takes another instance
            reason = str(error)
    if not found:
        raise InputError(f"{template.label}: none of {INSTANCES} random instances is possible: {reason}")
    across = [resolution.across for _, resolution in found]
    px = np.array([resolution.error_px for _, resolution in found])
    percent = np.array([resolution.error_percent for _, resolution in found])
    spacings = [resolution.spacing_mm for _, resolution in found]
    text = f"{min(across)} to {max(across)} elements across the contact, {min(spacings):.2g} to {max(spacings):.2g} mm"
    if plan.mesh.kind == "even":
        text = " x ".join(map(str, template.numerics.cells)) + f" elements for all trajectories of a pad, {text}"
    radii = [edge_radius_mm(scene, resolution.mesh) for scene, resolution in found]
    rounded = [radius for radius in radii if radius is not None]
    if rounded:
        text += f", edges of objects rounded to {min(rounded):.2g} to {max(rounded):.2g} mm"
    presses = [(scene, round(_order(scene) * len(resolution.mesh.points))) for scene, resolution in found]
    return presses, text, _spread(px), None if np.isnan(percent).any() else _spread(percent)


def _spread(errors: FloatArray) -> tuple[float, float]:
    return float(np.median(errors)), float(errors.max())


def _tetwild_meshes(plan: Plan) -> _Meshes:
    """Meshes of the corners, estimated without meshing; fTetWild takes long."""
    first = plan.template.corners[0]
    gel = first.sensor.gel
    edge_mm = edge_length(gel, plan.template.numerics)
    plate_mm, per_area = _plate(gel)
    x, y, z = (length / edge_mm for length in plate_mm)
    vertices = NODES_PER_VOLUME * x * y * z + per_area * 2 * (x * y + y * z + z * x)
    vertices += NODES_PER_CURVED_AREA * x * y * sum(elements_through(gel.layers_mm, edge_mm))
    nodes = max(FEWEST_NODES, round(_order(first) * vertices))
    text = f"fTetWild meshes with edges of {edge_mm:g} mm at the contact face"
    return [(corner, nodes) for corner in plan.template.corners], text, None, None


def _plate(gel: Gel) -> tuple[Vector3, float]:
    """Edge lengths of a box, and vertices per area of its faces; of a round gel what a press moves of it, laid flat."""
    thickness = gel.depth_mm
    match gel:
        case FileGel():
            x, y, z = gel.size_mm
            around, along = x + 2 * (1 + x / y) * (z - thickness), y
        case CapsuleGel():
            middle = gel.radius_mm - thickness / 2
            around, along = 2 * np.pi * middle, middle + gel.length_mm
        case _:
            return gel.size_mm, NODES_PER_AREA
    moved = 2 * (VICINITY + 1) * thickness
    return (min(around, moved), min(along, moved), thickness), NODES_PER_CURVED_AREA


def _order(scene: Scene) -> float:
    """Displacement nodes per vertex of the mesh."""
    return 1 if scene.numerics.element == "p1p1" else VERTICES_TO_P2


def _simulation_seconds(scene: Scene, nodes: int, plan: Plan) -> float:
    motion = scene.motion
    if motion.length_mm == 0:
        return 0.0
    steps = max(motion.length_mm / scene.numerics.max_step_mm, motion.steps)
    iterations = ITERATIONS_PER_STEP * steps + ITERATIONS_PER_RECORD * motion.steps
    if isinstance(scene.contact.indenter, MeshIndenter):
        iterations *= MESH_INDENTER
    if plan.is_batched:
        return iterations * BATCHED_SECONDS[plan.device] * (nodes / BATCHED_NODES) ** BATCHED_GROWTH
    friction = FRICTION if scene.contact.friction > 0 else 1.0
    return iterations * SOLVE_SECONDS * friction * (nodes / SOLVE_NODES) ** SOLVE_GROWTH
