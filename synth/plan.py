"""What a scene needs, decided once: what runs, what is left out and why, and what a pair will cost.

The costs are predictions from constants measured on one core of a 2-core x86-64 server; other machines differ by a
factor of two or three either way. Discretisation error is not predicted: see docs/reports for what was measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from synth.errors import InputError
from synth.mesh import default_edge_length
from synth.render.camera_rays import pinhole
from synth.render.lights import check_view
from synth.render.pattern import is_grey
from synth.render.variant import Variant
from synth.scene import Scene
from synth.simulate.indenter import rigid_body
from synth.simulate.path import TWIST_ARM_MM
from synth.simulate.system import DISPLACEMENT_ONLY_BELOW
from synth.template import Template

NODES_PER_VOLUME, NODES_PER_AREA, FEWEST_NODES = 0.72, 0.25, 300
"""Mesh nodes per cube and per square of the contact face's edge length, with `synth.mesh.tetrahedralise`'s grading."""
SOLVE_SECONDS = 0.065
"""One Newton iteration (assembly, factorisation, solution) of a frictional press with SOLVE_NODES nodes."""
SOLVE_NODES = 2000
SOLVE_GROWTH = 1.6
"""Exponent of a solve's time in the number of nodes (between 2D's 1.5 and 3D's 2 for a thin pad)."""
ITERATIONS_PER_STEP, STEPS_PER_RECORD = 10.0, 1.5
SECONDS_PER_MILLION_SAMPLES = {"llvm": 0.4, "scalar": 1.0, "cuda": 0.002}
"""Path-traced camera samples of one frame."""
FLOW_SECONDS_PER_MEGAPIXEL = 3.0
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
        edge_length_mm: of the mesh at the contact face.
        nodes: predicted mesh nodes.
        seconds_per_pair: predicted, by stage, on one core.
        bytes_per_pair: predicted size on disk.
    """

    scene: str
    variant: str
    decisions: tuple[Decision, ...]
    edge_length_mm: float
    nodes: int
    seconds_per_pair: dict[str, float]
    bytes_per_pair: int

    def record(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "scene": self.scene,
            "variant": self.variant,
            "decisions": [vars(decision) for decision in self.decisions],
            "edge_length_mm": self.edge_length_mm,
            "nodes": self.nodes,
            "seconds_per_pair": self.seconds_per_pair,
            "bytes_per_pair": self.bytes_per_pair,
        }


def check_buildable(template: Template, variant: Variant) -> None:
    """Build what fits the schema and may still be impossible, so that a job does not find out after its first hour.

    Raises:
        InputError: at a corner of the distributions, an indenter whose parts do not fit or whose file is no closed
            surface, a light in the camera's view, or a lens that this variant cannot render.
    """
    try:
        for sensor in dict.fromkeys(corner.sensor for corner in template.corners):
            check_view(sensor)
            if not variant.is_vectorised:
                pinhole(sensor)
        for indenter in dict.fromkeys(corner.contact.indenter for corner in template.corners):
            rigid_body(indenter, template.source.parent)
    except InputError as error:
        raise InputError(f"{template.source}: {error}") from error


def plan(template: Template, variant: Variant) -> Plan:
    """Plan a template by the corners of its distributions."""
    corners = template.corners
    scene = corners[0]
    gel, camera = scene.sensor.gel, scene.sensor.camera
    edge = scene.numerics.edge_length_mm or default_edge_length(gel)
    x, y, z = (length / edge for length in gel.size_mm)
    nodes = max(FEWEST_NODES, round(NODES_PER_VOLUME * x * y * z + NODES_PER_AREA * 2 * (x * y + y * z + z * x)))
    pairs = scene.sampling.pairs_per_trajectory
    simulate = sum(_simulation_seconds(corner, nodes) for corner in corners) / len(corners)
    pixels = camera.width * camera.height
    kind = variant.name.split("_")[0]
    frame = pixels * scene.render.samples_per_pixel / 1e6 * SECONDS_PER_MILLION_SAMPLES[kind]
    directions = 2 if scene.outputs.backward else 1
    frames_per_pair = 1 + 1 / pairs
    return Plan(
        scene=template.name,
        variant=variant.name,
        decisions=tuple(_decisions(corners, variant)),
        edge_length_mm=edge,
        nodes=nodes,
        seconds_per_pair={
            "simulate": round(simulate / pairs, 3),
            "render": round(frame * frames_per_pair, 3),
            "flow": round(directions * pixels / 1e6 * FLOW_SECONDS_PER_MEGAPIXEL, 3),
        },
        bytes_per_pair=round(pixels * (BYTES_PER_PIXEL_OF_FLOW * directions / 2 + 2 * BYTES_PER_PIXEL_OF_IMAGE)),
    )


def _simulation_seconds(scene: Scene, nodes: int) -> float:
    motion = scene.motion
    if motion.depth_mm <= 0:
        return 0.0
    drag = abs(motion.shear_mm[0]) + abs(motion.shear_mm[1]) + abs(motion.twist_deg) * 0.01745 * TWIST_ARM_MM
    steps = max((motion.depth_mm + drag) / scene.numerics.max_step_mm, STEPS_PER_RECORD * motion.steps)
    friction = 1.0 if scene.contact.friction > 0 else 0.6
    return steps * ITERATIONS_PER_STEP * SOLVE_SECONDS * friction * (nodes / SOLVE_NODES) ** SOLVE_GROWTH


def _decisions(corners: tuple[Scene, ...], variant: Variant) -> list[Decision]:
    outputs = corners[0].outputs
    depth, friction = [c.motion.depth_mm for c in corners], [c.contact.friction for c in corners]
    poisson = [c.sensor.gel.poisson_ratio for c in corners]
    index, bounces = [c.sensor.window.refractive_index for c in corners], [c.render.max_depth for c in corners]
    mixed = max(poisson) >= DISPLACEMENT_ONLY_BELOW
    lens = any(any(c.sensor.camera.distortion) for c in corners)
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
