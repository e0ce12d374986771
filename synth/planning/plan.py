"""What a scene needs, decided once: what runs, what is left out and why, and what a pair will cost.

The costs are predictions from constants measured on one core of a 2-core x86-64 server; other machines differ by a
factor of two or three either way. Errors are predictions of `synth.simulate.resolution`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.errors import InputError
from synth.render.camera_rays import pinhole
from synth.render.lights import check_view
from synth.render.pattern import check_pattern, is_grey
from synth.render.separated_light import check_light
from synth.render.thin_lens import ThinLens
from synth.render.variant import Variant
from synth.scene import MeshIndenter, Scene
from synth.scene.sampling import check_pairs, draw
from synth.scene.template import Template
from synth.simulate.indenter import object_radius, rigid_body
from synth.simulate.material import DISPLACEMENT_ONLY_BELOW
from synth.simulate.object_surface import object_triangles
from synth.simulate.path import TWIST_ARM_MM
from synth.simulate.resolution import DEFAULT_TARGET_PX, Resolution
from synth.simulate.shared import resolution_of

DRAWS = 12
"""Draws of the scene whose meshes are chosen to predict error and time."""
NODES_PER_VOLUME, NODES_PER_AREA, FEWEST_NODES = 0.72, 0.25, 300
"""Mesh vertices per cube and per square of the contact face's edge length, for fTetWild's meshes."""
VERTICES_TO_P2 = 7.0
"""Displacement nodes of P2 elements per vertex of the mesh."""
SOLVE_SECONDS = 0.06
"""One Newton iteration (assembly, factorisation, solution) without friction, with SOLVE_NODES displacement nodes; from
24 pairs of `gelsight_mini`, 2.36 s a pair on one core."""
SOLVE_NODES = 5000
SOLVE_GROWTH = 1.25
"""Exponent of a solve's time in the nodes, fitted to 2,079 to 9,044 of them."""
FRICTION = 1.5
"""Time of an iteration with friction over one without."""
ITERATIONS_PER_STEP, ITERATIONS_PER_RECORD = 4.5, 7.0
BATCHED_SECONDS = {"cuda": 5.5e-5, "cpu": 0.8}
"""One Newton iteration of one trajectory by the batched solver, with BATCHED_NODES displacement nodes; on a GPU among
hundreds of trajectories (docs/reports/h200.md)."""
BATCHED_NODES = 3500
BATCHED_GROWTH = 1.6
"""Exponent of that in the number of nodes: the preconditioner is a dense matrix, the rest is linear."""
AUTO_SAMPLES = 64
"""What samples_per_pixel = "auto" counts for, before a sensor has been measured."""
SECONDS_PER_MILLION_SAMPLES = {"llvm": 0.4, "scalar": 1.0, "cuda": 0.002}
"""Path-traced camera samples of one frame."""
FLOW_SECONDS_PER_MEGAPIXEL = 1.0
BYTES_PER_PIXEL_OF_FLOW = 14.0
BYTES_PER_PIXEL_OF_IMAGE = 1.4


@dataclass(frozen=True)
class Decision:
    """Whether a feature runs, and why."""

    feature: str
    runs: bool
    reason: str


@dataclass(frozen=True)
class Plan:
    """Decisions and predictions for one scene.

    Attributes:
        decisions: feature by feature.
        resolution: how fine the meshes are, in words.
        error_px: predicted error of the flow from the simulation: median and largest of DRAWS draws; NaN where the
            mesh is given by an edge length, for which nothing is predicted.
        target_error_px: what was asked for; NaN with an edge length.
        nodes: displacement nodes, mean of the draws.
        seconds_per_pair: predicted, by stage, on one core.
        bytes_per_pair: predicted size on disk.
    """

    scene: str
    variant: str
    decisions: tuple[Decision, ...]
    resolution: str
    error_px: tuple[float, float]
    target_error_px: float
    nodes: int
    seconds_per_pair: dict[str, float]
    bytes_per_pair: int

    def record(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "scene": self.scene,
            "variant": self.variant,
            "decisions": [vars(decision) for decision in self.decisions],
            "resolution": self.resolution,
            "error_px": None if np.isnan(self.target_error_px) else list(self.error_px),
            "target_error_px": None if np.isnan(self.target_error_px) else self.target_error_px,
            "nodes": self.nodes,
            "seconds_per_pair": self.seconds_per_pair,
            "bytes_per_pair": self.bytes_per_pair,
        }


def check_buildable(template: Template, variant: Variant) -> None:
    """Build what fits the schema and may still be impossible, so that a job does not find out after its first hour.

    Raises:
        InputError: at a corner of the distributions, an indenter whose parts do not fit or whose file is no surface,
            a light in the camera's view, a lens or a kind of light that this variant or coating cannot have, a pattern
            that no pixel could show or whose file is no picture, or more pairs than a trajectory has.
    """
    try:
        for sensor in dict.fromkeys(view for corner in template.corners for view in corner.sensor.views.values()):
            check_view(sensor)
            ThinLens.of(sensor)
            if not variant.is_vectorised:
                pinhole(sensor)
        for sensor in dict.fromkeys(corner.sensor for corner in template.corners):
            check_pattern(sensor, template.source.parent)
            if template.corners[0].render.light == "separated":
                check_light(sensor.coating)
        for indenter in dict.fromkeys(corner.contact.indenter for corner in template.corners):
            if isinstance(indenter, MeshIndenter):
                object_triangles(indenter, template.source.parent)
            else:
                rigid_body(indenter)
        for corner in template.corners:
            check_pairs(corner)
    except InputError as error:
        raise InputError(f"{template.label}: {error}") from error


def plan(template: Template, variant: Variant) -> Plan:
    """Plan a template by the corners of its distributions."""
    corners = template.corners
    scene = corners[0]
    cameras = [view.camera for view in scene.sensor.views.values()]
    pairs = scene.sampling.pairs_per_trajectory
    meshes, gpu = _meshes(template), variant.name.startswith("cuda")
    simulate = sum(_simulation_seconds(draw, nodes, gpu) for draw, nodes in meshes.draws) / len(meshes.draws)
    pixels = sum(camera.width * camera.height for camera in cameras)
    kind = variant.name.split("_")[0]
    samples = AUTO_SAMPLES if scene.render.samples_per_pixel == "auto" else scene.render.samples_per_pixel
    frame = pixels * samples / 1e6 * SECONDS_PER_MILLION_SAMPLES[kind]
    directions = 2 if scene.outputs.backward else 1
    frames_per_pair = 1 + 1 / pairs
    return Plan(
        scene=template.name,
        variant=variant.name,
        decisions=(_batching(template), *_decisions(corners, variant)),
        resolution=meshes.resolution,
        error_px=meshes.error_px,
        target_error_px=meshes.target_error_px,
        nodes=round(sum(nodes for _, nodes in meshes.draws) / len(meshes.draws)),
        seconds_per_pair={
            "simulate": round(simulate / pairs, 3),
            "render": round(frame * frames_per_pair, 3),
            "flow": round(directions * pixels / 1e6 * FLOW_SECONDS_PER_MEGAPIXEL, 3),
        },
        bytes_per_pair=round(pixels * (BYTES_PER_PIXEL_OF_FLOW * directions / 2 + 2 * BYTES_PER_PIXEL_OF_IMAGE)),
    )


@dataclass(frozen=True)
class _Meshes:
    """Some draws with their displacement nodes, and what Plan says of their meshes."""

    draws: tuple[tuple[Scene, int], ...]
    resolution: str
    error_px: tuple[float, float]
    target_error_px: float


def _meshes(template: Template) -> _Meshes:
    """Choose the meshes of the first DRAWS trajectories, as `generate` will."""
    numerics = template.corners[0].numerics
    if numerics.edge_length_mm is not None:
        nodes = _tetwild_nodes(template.corners[0])
        text = f"fTetWild meshes with edges of {numerics.edge_length_mm:g} mm at the contact face"
        return _Meshes(tuple((c, nodes) for c in template.corners), text, (np.nan, np.nan), np.nan)
    found: list[tuple[Scene, Resolution]] = []
    for trajectory in range(DRAWS):
        try:
            drawn = draw(template, 0, trajectory)
            found.append((drawn, resolution_of(drawn, template.source.parent)))
        except InputError:  # an impossible draw: generate redraws it
            continue
    if not found:
        raise InputError(f"{template.label}: none of {DRAWS} draws is possible; try `simulate` to see why")
    across = [resolution.across for _, resolution in found]
    errors = [resolution.error_px for _, resolution in found]
    spacings = [resolution.spacing_mm for _, resolution in found]
    text = f"{min(across)} to {max(across)} elements across the contact, {min(spacings):.2g} to {max(spacings):.2g} mm"
    if numerics.solver == "batched":
        text = " x ".join(map(str, numerics.cells)) + f" elements for all draws of a pad, {text}"
    radii = [_edge_radius(drawn, resolution) for drawn, resolution in found]
    rounded = [radius for radius in radii if radius is not None]
    if rounded:
        text += f", edges of objects rounded to {min(rounded):.2g} to {max(rounded):.2g} mm"
    order = 1 if numerics.element == "p1p1" else VERTICES_TO_P2
    draws = tuple((drawn, round(order * len(resolution.mesh.points))) for drawn, resolution in found)
    target = numerics.target_error_px or DEFAULT_TARGET_PX
    return _Meshes(draws, text, (float(np.median(errors)), max(errors)), target)


def _edge_radius(scene: Scene, resolution: Resolution) -> float | None:
    """Of a mesh indenter's edges, mm."""
    indenter, order = scene.contact.indenter, 1 if scene.numerics.element == "p1p1" else 2
    if not isinstance(indenter, MeshIndenter):
        return None
    return object_radius(indenter, resolution.mesh.spacing_mm / (2 * order))


def _tetwild_nodes(scene: Scene) -> int:
    x, y, z = (length / (scene.numerics.edge_length_mm or 1.0) for length in scene.sensor.gel.size_mm)
    vertices = NODES_PER_VOLUME * x * y * z + NODES_PER_AREA * 2 * (x * y + y * z + z * x)
    order = 1 if scene.numerics.element == "p1p1" else VERTICES_TO_P2
    return max(FEWEST_NODES, round(order * vertices))


def _simulation_seconds(scene: Scene, nodes: int, gpu: bool) -> float:
    motion = scene.motion
    if motion.depth_mm <= 0 and not motion.then:
        return 0.0
    drag = abs(motion.shear_mm[0]) + abs(motion.shear_mm[1]) + abs(motion.twist_deg) * 0.01745 * TWIST_ARM_MM
    steps = max((motion.depth_mm + drag) / scene.numerics.max_step_mm, motion.steps)
    iterations = ITERATIONS_PER_STEP * steps + ITERATIONS_PER_RECORD * motion.steps
    if scene.numerics.solver == "batched":
        return iterations * BATCHED_SECONDS["cuda" if gpu else "cpu"] * (nodes / BATCHED_NODES) ** BATCHED_GROWTH
    friction = FRICTION if scene.contact.friction > 0 else 1.0
    return iterations * SOLVE_SECONDS * friction * (nodes / SOLVE_NODES) ** SOLVE_GROWTH


def _batching(template: Template) -> Decision:
    """Whether trajectories are simulated many at once, and whether that is worth it."""
    solver = template.corners[0].numerics.solver
    reason = f'numerics.solver = "{solver}"'
    if solver == "batched":
        # Without layers stiffness only scales forces, so that pads which differ in nothing else share a mesh.
        alike = () if template.corners[0].sensor.gel.layers else ("sensor.gel.youngs_modulus_kpa",)
        drawn = [at for _, _, at in template.distributions() if at.startswith("sensor.gel.") and at not in alike]
        if drawn:
            reason += f": but {', '.join(drawn)} make each sensor's pad another, with a mesh and a batch of its own"
    return Decision("batched simulation", solver == "batched", reason)


def _decisions(corners: tuple[Scene, ...], variant: Variant) -> list[Decision]:
    outputs = corners[0].outputs
    depth, friction = [c.motion.depth_mm for c in corners], [c.contact.friction for c in corners]
    poisson = [c.sensor.gel.poisson_ratio for c in corners]
    index, bounces = [c.sensor.window.refractive_index for c in corners], [c.render.max_depth for c in corners]
    mixed = max(poisson) >= DISPLACEMENT_ONLY_BELOW
    cameras = [view.camera for c in corners for view in c.sensor.views.values()]
    lens = any(any(camera.distortion) or camera.lens == "fisheye" for camera in cameras)
    flat = all(c.sensor.gel.shape == "box" for c in corners)
    apertures = [camera.aperture_mm for camera in cameras]
    blurred = max(apertures) > 0
    mirrors, further = len(corners[0].sensor.mirrors), len(corners[0].sensor.further_cameras)
    light = corners[0].render.light
    separated = light == "separated" and variant.is_vectorised
    instead = f", but {variant.name} path-traces" if light == "separated" and not separated else ""
    grey = all(is_grey(c.sensor) for c in corners)
    hue = "lights, coating and pattern are grey" if grey else "a light, the coating or the pattern has colour"
    if grey and not variant.is_mono:
        hue += f", but {variant.name} has no grey counterpart here"
    optional = [name for name in ("depth", "normal", "displacement", "traction", "contact") if getattr(outputs, name)]
    foam = "" if mixed else ": a compressible foam needs none"
    smooth = "" if max(friction) > 0 else ": half the matrix is enough"
    return [
        Decision("simulation", max(depth) > 0, _span("motion.depth_mm", depth)),
        Decision("friction state", max(friction) > 0, _span("contact.friction", friction) + smooth),
        Decision("pressure field", mixed, _span("sensor.gel.poisson_ratio", poisson) + foam),
        Decision("window refraction", max(index) > 1, _span("sensor.window.refractive_index", index)),
        Decision("lens distortion", lens, "sensor.camera.distortion" + ("" if lens else " is zero: a pinhole")),
        Decision("shared undeformed frame", flat, "sensor.gel.shape" + ("" if flat else ": domes have own meshes")),
        Decision(
            "depth of field",
            blurred,
            _span("sensor.camera.aperture_mm", apertures) + ("" if blurred else ": a pinhole"),
        ),
        Decision("mirrors", mirrors > 0, f"{mirrors} in sensor.mirrors"),
        Decision("further cameras", further > 0, f"{further} in sensor.further_cameras"),
        Decision("separated light", separated, f"render.light = {light}{instead}"),
        Decision("indirect light", max(bounces) > 2, _span("render.max_depth", bounces)),
        Decision("colour", not variant.is_mono, hue),
        Decision("backward flow", outputs.backward, f"outputs.backward = {str(outputs.backward).lower()}"),
        Decision("optional channels", bool(optional), ", ".join(optional) or "none asked for in outputs"),
        Decision("indenter in the picture", False, "the coating is opaque"),
    ]


def _span(name: str, values: Sequence[float]) -> str:
    """What a field is at the corners."""
    low, high = min(values), max(values)
    return f"{name} = {low:g}" if low == high else f"{name} = {low:g} to {high:g}"
