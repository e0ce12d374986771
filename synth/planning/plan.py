"""What a scene needs, decided once; what comes later is handed the plan and asks nothing again."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from synth.errors import InputError
from synth.mesh import edge_length, face_of
from synth.mesh.cad import CadFace
from synth.press.indenter import object_triangles, rigid_body
from synth.press.press import MeshRule
from synth.press.scene_path import path_of
from synth.render.camera_rays import pinhole
from synth.render.coating import is_separated
from synth.render.measured_light import read_measured_light
from synth.render.pattern import check_pattern
from synth.render.rest_map import read_rest_map
from synth.render.thin_lens import check_views
from synth.render.variant import Variant, always_grey, job_variant
from synth.sampling import check_pairs
from synth.scene import MeshIndenter
from synth.scene.template import Template, load_scene
from synth.simulate.material import DISPLACEMENT_ONLY_BELOW


@dataclass(frozen=True)
class Decision:
    """Whether a feature runs, and why."""

    feature: str
    runs: bool
    reason: str


@dataclass(frozen=True)
class Plan:
    """What runs, for all samples of a scene; picklable.

    `template.outputs` and `template.sampling` are the same for all. With `is_batched` trajectories are simulated many
    at once, on one mesh for all of a pad. Light and lens are each sensor's own.
    """

    template: Template
    variant: Variant
    is_batched: bool
    mesh: MeshRule

    @property
    def device(self) -> Literal["cuda", "cpu"]:
        """Where the batched solver runs, and the flow is traced: where pictures are rendered."""
        return "cuda" if self.variant.is_on_gpu else "cpu"

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Feature by feature what runs for some sample at least, with the reason."""
        variant, corners, outputs = self.variant, self.template.corners, self.template.outputs
        sensors, posed = [c.sensor for c in corners], any(c.motion.poses for c in corners)
        depth = [max(stop.depth_mm for stop in c.motion.stops.values()) for c in corners]
        press = "motion.poses" if posed else _span("motion.depth_mm", depth)
        friction, poisson = [c.contact.friction for c in corners], [s.gel.poisson_ratio for s in sensors]
        index, bounces = [s.window.refractive_index for s in sensors], [c.render.max_depth for c in corners]
        mixed = max(poisson) >= DISPLACEMENT_ONLY_BELOW
        cameras = [view.camera for s in sensors for view in s.views.values()]
        apertures = [camera.aperture_mm for camera in cameras]
        pinhole = "" if max(apertures) > 0 else ": a pinhole"
        lens = any(any(camera.distortion) or camera.lens == "fisheye" for camera in cameras)
        own_frames = ": domes have own frames" if any(s.gel.shape == "dome" for s in sensors) else ""
        mirrors, further = max(len(s.mirrors) for s in sensors), max(len(s.further_cameras) for s in sensors)
        lights = {c.render.light for c in corners}
        separated = any(is_separated(c.render, c.sensor, variant) for c in corners)
        instead = f", but {variant.name} path-traces" if "separated" in lights and not separated else ""
        contained = ": measured light contains it" if all(s.measured_light for s in sensors) else ""
        paths = _span("render.max_depth", bounces) + contained
        hue = "lights, coating and pattern are grey"
        if not always_grey(self.template):
            hue = "a light, the coating, the pattern or a rest map has colour"
        elif not variant.is_mono:
            hue += f", but {variant.name} has no grey counterpart here"
        names = ("depth", "normal", "displacement", "traction", "contact", "slip", "previous")
        optional = [name for name in names if getattr(outputs, name)]
        foam = "" if mixed else ": a compressible foam needs none"
        smooth = "" if max(friction) > 0 else ": half the matrix is enough"
        return (
            Decision("batched simulation", self.is_batched, _batching_reason(self, posed)),
            Decision("pictures", outputs.images, f"outputs.images = {str(outputs.images).lower()}"),
            Decision("simulation", posed or max(depth) > 0, press),
            Decision("friction state", max(friction) > 0, _span("contact.friction", friction) + smooth),
            Decision("pressure field", mixed, _span("sensor.gel.poisson_ratio", poisson) + foam),
            Decision("window refraction", max(index) > 1, _span("sensor.window.refractive_index", index)),
            Decision("lens distortion", lens, "sensor.camera.distortion" + ("" if lens else " is zero: a pinhole")),
            Decision("shared undeformed frame", not own_frames, "sensor.gel.shape" + own_frames),
            Decision("depth of field", max(apertures) > 0, _span("sensor.camera.aperture_mm", apertures) + pinhole),
            Decision("mirrors", mirrors > 0, f"{mirrors} in sensor.mirrors"),
            Decision("further cameras", further > 0, f"{further} in sensor.further_cameras"),
            Decision("separated light", separated, f"render.light = {' or '.join(sorted(lights))}{instead}"),
            Decision("indirect light", max(bounces) > 2 and not contained, paths),
            Decision("colour", not variant.is_mono, hue),
            Decision("backward flow", outputs.backward, f"outputs.backward = {str(outputs.backward).lower()}"),
            Decision("optional channels", bool(optional), ", ".join(optional) or "none asked for in outputs"),
        )

    def record(self) -> dict[str, Any]:
        named = {"scene": self.template.name, "variant": self.variant.name}
        return {**named, "decisions": [vars(decision) for decision in self.decisions]}


def plan(scene: Template | str | Path, variant: Variant | None = None) -> Plan:
    """Decide what runs, with reasons.

    Args:
        scene: of `load_scene`, or the name or path of one.
        variant: the renderer; by default the fastest here that the scene needs.

    Raises:
        InputError: what the scene asks for cannot be built, see `check_buildable`.

    Examples:
        >>> from synth import load_scene
        >>> planned = plan(load_scene("gelsight_mini", set=["contact.friction=0.0"]))
        >>> [decision.reason for decision in planned.decisions if decision.feature == "friction state"]
        ['contact.friction = 0: half the matrix is enough']
    """
    scene = scene if isinstance(scene, Template) else load_scene(scene)
    variant = variant or job_variant(scene, "auto")
    check_buildable(scene, variant)
    suits = variant.is_on_gpu and not any(corner.motion.poses for corner in scene.corners) and not _own_pads(scene)
    batched = scene.numerics.solver == "batched" or (scene.numerics.solver == "auto" and suits)
    rules = [MeshRule.of(corner, batched) for corner in scene.corners]
    return Plan(scene, variant, batched, max(rules, key=lambda rule: rule.kind == "tetwild"))


def check_buildable(template: Template, variant: Variant) -> None:
    """Build what fits the schema and may still be impossible, so that a job does not find out after its first hour.

    InputError, at a corner of the distributions, for an indenter whose parts do not fit or whose file is no surface, a
    gel from files that is too thin or is pressed beside its face, a light in the camera's view, a lens or a kind of
    light that this variant or coating cannot have, a pattern that no pixel could show or whose file is no picture, a
    rest map or measured light that does not fit camera or lights, more pairs than a trajectory has, or poses for the
    batched solver.
    """
    try:
        for sensor in dict.fromkeys(corner.sensor for corner in template.corners):
            check_views(sensor)
            check_pattern(sensor, template.folder)
            read_measured_light(sensor, template.folder)
            for camera in sensor.cameras.values():
                read_rest_map(camera, template.folder)
            for view in () if variant.is_vectorised else sensor.views.values():
                pinhole(view)
        for indenter in dict.fromkeys(corner.contact.indenter for corner in template.corners):
            if isinstance(indenter, MeshIndenter):
                object_triangles(indenter, template.folder)
            else:
                rigid_body(indenter)
        for corner in template.corners:
            gel = corner.sensor.gel
            if isinstance(face := face_of(gel, template.folder), CadFace):
                face.check(corner.motion, edge_length(gel, corner.numerics))
            if corner.motion.poses and corner.contact.indenter.rotation_deg != "any":
                path_of(corner, template.folder).check()
            is_separated(corner.render, corner.sensor, variant)
            check_pairs(corner)
            if corner.motion.poses and corner.numerics.solver == "batched":
                raise InputError('numerics.solver = "batched": it takes no motion.poses; give "single" or "auto"')
    except InputError as error:
        raise InputError(f"{template.label}: {error}") from error


def _batching_reason(plan: Plan, posed: bool) -> str:
    solver, drawn = plan.template.numerics.solver, _own_pads(plan.template)
    reason = f'numerics.solver = "{solver}"'
    if posed:
        return f"{reason}, and motion.poses are simulated one by one"
    if drawn and (solver == "batched" or plan.variant.is_on_gpu):
        return f"{reason}: but {', '.join(drawn)} make each sensor's pad another, with a mesh and a batch of its own"
    return f"{reason}, and {plan.variant.name} renders" if solver == "auto" else reason


def _own_pads(template: Template) -> list[str]:
    """The distributions by which each sensor's pad needs a mesh of its own."""
    # Without layers stiffness only scales forces, so that pads which differ in nothing else share a mesh.
    alike = () if template.corners[0].sensor.gel.layers else ("sensor.gel.youngs_modulus_kpa",)
    return [at for _, _, at in template.distributions() if at.startswith("sensor.gel.") and at not in alike]


def _span(name: str, values: Sequence[float]) -> str:
    low, high = min(values), max(values)
    return f"{name} = {low:g}" if low == high else f"{name} = {low:g} to {high:g}"
