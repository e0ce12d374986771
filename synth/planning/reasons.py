"""Which features a scene needs, and why."""

from collections.abc import Sequence
from dataclasses import dataclass

from synth.render.pattern import is_grey
from synth.render.separated_light import is_separated
from synth.render.variant import Variant
from synth.scene.template import Template
from synth.simulate.material import DISPLACEMENT_ONLY_BELOW


@dataclass(frozen=True)
class Decision:
    """Whether a feature runs, and why."""

    feature: str
    runs: bool
    reason: str


def decisions(template: Template, variant: Variant, is_batched: bool) -> tuple[Decision, ...]:
    """Feature by feature, from the corners of a template's distributions."""
    corners = template.corners
    outputs = template.outputs
    depth, friction = [c.motion.depth_mm for c in corners], [c.contact.friction for c in corners]
    poisson = [c.sensor.gel.poisson_ratio for c in corners]
    index, bounces = [c.sensor.window.refractive_index for c in corners], [c.render.max_depth for c in corners]
    mixed = max(poisson) >= DISPLACEMENT_ONLY_BELOW
    cameras = [view.camera for c in corners for view in c.sensor.views.values()]
    lens = any(any(camera.distortion) or camera.lens == "fisheye" for camera in cameras)
    flat = all(c.sensor.gel.is_flat for c in corners)
    own_frames = "" if flat else ": curved faces have own frames"
    apertures = [camera.aperture_mm for camera in cameras]
    pinhole = "" if max(apertures) > 0 else ": a pinhole"
    mirrors, further = len(corners[0].sensor.mirrors), len(corners[0].sensor.further_cameras)
    light = corners[0].render.light
    separated = is_separated(corners[0].render, corners[0].sensor.coating, variant)
    instead = f", but {variant.name} path-traces" if light == "separated" and not separated else ""
    grey = all(is_grey(c.sensor) for c in corners)
    hue = "lights, coating and pattern are grey" if grey else "a light, the coating or the pattern has colour"
    if grey and not variant.is_mono:
        hue += f", but {variant.name} has no grey counterpart here"
    optional = [name for name in ("depth", "normal", "displacement", "traction", "contact") if getattr(outputs, name)]
    foam = "" if mixed else ": a compressible foam needs none"
    smooth = "" if max(friction) > 0 else ": half the matrix is enough"
    return (
        _batching(template, is_batched),
        Decision("simulation", max(depth) > 0, _span("motion.depth_mm", depth)),
        Decision("friction state", max(friction) > 0, _span("contact.friction", friction) + smooth),
        Decision("pressure field", mixed, _span("sensor.gel.poisson_ratio", poisson) + foam),
        Decision("window refraction", max(index) > 1, _span("sensor.window.refractive_index", index)),
        Decision("lens distortion", lens, "sensor.camera.distortion" + ("" if lens else " is zero: a pinhole")),
        Decision("shared undeformed frame", flat, "sensor.gel.shape" + own_frames),
        Decision("depth of field", max(apertures) > 0, _span("sensor.camera.aperture_mm", apertures) + pinhole),
        Decision("mirrors", mirrors > 0, f"{mirrors} in sensor.mirrors"),
        Decision("further cameras", further > 0, f"{further} in sensor.further_cameras"),
        Decision("separated light", separated, f"render.light = {light}{instead}"),
        Decision("indirect light", max(bounces) > 2, _span("render.max_depth", bounces)),
        Decision("colour", not variant.is_mono, hue),
        Decision("backward flow", outputs.backward, f"outputs.backward = {str(outputs.backward).lower()}"),
        Decision("optional channels", bool(optional), ", ".join(optional) or "none asked for in outputs"),
        Decision("indenter in the picture", False, "the coating is opaque"),
    )


def _batching(template: Template, is_batched: bool) -> Decision:
    """Whether trajectories are simulated many at once, and whether that is worth it."""
    reason = f'numerics.solver = "{template.numerics.solver}"'
    if is_batched:
        # Without layers stiffness only scales forces, so that pads which differ in nothing else share a mesh.
        alike = () if template.corners[0].sensor.gel.layers else ("sensor.gel.youngs_modulus_kpa",)
        drawn = [at for _, _, at in template.distributions() if at.startswith("sensor.gel.") and at not in alike]
        if drawn:
            reason += f": but {', '.join(drawn)} make each sensor's pad another, with a mesh and a batch of its own"
    return Decision("batched simulation", is_batched, reason)


def _span(name: str, values: Sequence[float]) -> str:
    """What a field is at the corners."""
    low, high = min(values), max(values)
    return f"{name} = {low:g}" if low == high else f"{name} = {low:g} to {high:g}"
