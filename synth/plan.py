"""What a scene needs, decided once: what runs, what is left out and why, and what a pair will cost.

The costs are predictions from constants measured on one core of a 2-core x86-64 server; other machines differ by a factor
of two or three either way. Discretisation error is not predicted: see docs/reports for what was measured.
"""

from dataclasses import dataclass
from typing import Any

from synth.mesh import default_edge_length
from synth.render.pattern import is_grey
from synth.render.variant import Variant
from synth.scene import Scene
from synth.simulate.path import TWIST_ARM_MM
from synth.simulate.system import DISPLACEMENT_ONLY_BELOW
from synth.template import Template

NODES_PER_VOLUME = 1.25
"""Mesh nodes per cubed edge length of the contact face, for the grading of `synth.mesh.tetrahedralise`."""
SOLVE_SECONDS = 0.035
"""One Newton iteration (assembly, factorisation, solution) of a frictional press with SOLVE_NODES nodes."""
SOLVE_NODES = 2000
SOLVE_GROWTH = 1.6
"""Exponent of a solve's time in the number of nodes (between 2D's 1.5 and 3D's 2 for a thin pad)."""
ITERATIONS_PER_STEP, STEPS_PER_RECORD = 6.0, 1.5
SECONDS_PER_MILLION_SAMPLES = {"llvm": 0.25, "scalar": 1.0, "cuda": 0.002}
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
        seconds_per_pair: predicted, by stage, on one core (rendering: on all).
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


def plan(template: Template, variant: Variant) -> Plan:
    """Plan a template by the corners of its distributions."""
    corners = template.corners
    scene = corners[0]
    gel, camera = scene.sensor.gel, scene.sensor.camera
    edge = scene.numerics.edge_length_mm or default_edge_length(gel)
    nodes = round(NODES_PER_VOLUME * gel.size_mm[0] * gel.size_mm[1] * gel.size_mm[2] / edge**3 / 2)
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
    scene = corners[0]
    touches = any(corner.motion.depth_mm > 0 for corner in corners)
    slips = any(corner.contact.friction > 0 for corner in corners)
    mixed = scene.sensor.gel.poisson_ratio >= DISPLACEMENT_ONLY_BELOW
    refracts = scene.sensor.window.refractive_index != 1
    lens = any(any(corner.sensor.camera.distortion) for corner in corners)
    depth = scene.render.max_depth
    grey = all(is_grey(corner.sensor) for corner in corners)
    optional = [
        name for name in ("depth", "normal", "displacement", "traction", "contact") if getattr(scene.outputs, name)
    ]
    return [
        Decision("simulation", touches, "some draws press the gel" if touches else "no draw touches the gel"),
        Decision(
            "friction state",
            slips,
            "contact.friction > 0" if slips else "contact.friction = 0: half the matrix is enough",
        ),
        Decision(
            "pressure field",
            mixed,
            f"Poisson's ratio {scene.sensor.gel.poisson_ratio} "
            + (
                f">= {DISPLACEMENT_ONLY_BELOW}"
                if mixed
                else f"< {DISPLACEMENT_ONLY_BELOW}: a compressible foam needs none"
            ),
        ),
        Decision(
            "window refraction", refracts, f"sensor.window.refractive_index = {scene.sensor.window.refractive_index}"
        ),
        Decision("lens distortion", lens, "sensor.camera.distortion" + ("" if lens else " is zero: a pinhole")),
        Decision("indirect light", depth > 2, f"render.max_depth = {depth}"),
        Decision(
            "colour",
            not variant.is_mono,
            "lights, coating and pattern are grey" if grey else "a light or the pattern has colour",
        ),
        Decision("backward flow", scene.outputs.backward, f"outputs.backward = {str(scene.outputs.backward).lower()}"),
        Decision("optional channels", bool(optional), ", ".join(optional) or "none asked for in outputs"),
        Decision("indenter in the picture", False, "the coating is opaque"),
    ]
