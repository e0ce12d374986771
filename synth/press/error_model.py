r"""The error that a mesh is expected to leave in the displacement of the contact face.

A press of P2/P1 elements errs where the contact ends: pressure and friction end in kinks there. With h the size of the
elements under the contact and l the length of its rim, and u and r the mesh's displacement and the exact one,

.. math::  E = \sqrt{\int |u - r|^2 dA} = c k \sqrt{l / b} \sqrt{d m} \, T^{-0.6} h^{1.6},
           \qquad m = d + \sqrt{\min(\mu, 1)} \max (2 |s| + w |\theta|)

in mm², lengths in mm: d press depth, b half width of the band that touches at that depth (so that d / b is how steeply
the indenter's surface meets the gel), T thickness of the pad, s shear, theta twist in rad, w larger half width of the
zone, mu friction, k a number for each shape of indenter and c a factor for certainty. The powers of the lengths add up
to two: a press of twice the size errs by twice as much, on the same mesh of twice the size.

The powers were set by hand near those of free fits, which predict other trajectories hardly better; k was fitted
(docs/reports/budget.md). Covered are flat pads of 2.5 to 16 mm and a dome, depths to 40 % of the thickness, friction of
0.3 to 1, elements 0.4 to 2.7 b wide; all but one of the pads are incompressible.
"""

import numpy as np

from synth.mesh import Focus
from synth.scene import Box, Cone, Cylinder, Indenter, MeshIndenter, Scene, Sphere, Torus
from synth.scene.indenter import DEFAULT_FILLET_MM

RATE = 1.6
"""Power of the spacing h."""
ERROR_SCALES = {
    "sphere": 0.065,
    "cone": 0.054,
    "bar": 0.098,
    "punch": 0.086,
    "box": 0.087,
    "torus": 0.082,
    "mesh": 0.19,
}
"""k of the error model; a bar is a cylinder that lies, a punch one that stands. "mesh" is the largest that the others
have if their band is taken for as wide as a mesh's."""
CERTAINTY = 1.1
"""Factor on the model's mean. It weighs meshes too coarse against meshes too dear (docs/decisions.md)."""


def face_error(scene: Scene, focus: Focus, spacing_mm: float) -> float:
    """E of the error model, mm², of an instance that touches at a focus; 0 for an indenter that does not touch.

    `spacing_mm` is the size of the elements under the contact, as `synth.press.resolution` has it.
    """
    motion, indenter = scene.motion, scene.contact.indenter
    poses = motion.stops.values()
    depth = max(pose.depth_mm for pose in poses)
    if depth <= 0:
        return 0.0
    width = max(focus.half_mm)
    drag = max(2 * np.hypot(*pose.shear_mm) + width * abs(np.radians(pose.twist_deg)) for pose in poses)
    moved = depth + np.sqrt(min(scene.contact.friction, 1.0)) * drag
    rim, band = _rim(indenter, focus), _band(indenter, focus, depth)
    scale = CERTAINTY * ERROR_SCALES[_class_of(indenter)] * scene.sensor.gel.size_mm[2] ** -0.6
    return float(scale * np.sqrt(rim / band * depth * moved) * spacing_mm**RATE)


def _class_of(indenter: Indenter) -> str:
    if not isinstance(indenter, Cylinder):
        return indenter.shape
    tilted = np.hypot(np.sin(np.radians(indenter.rotation_deg[0])), np.sin(np.radians(indenter.rotation_deg[1])))
    return "bar" if tilted > 0.5 else "punch"


def _rim(indenter: Indenter, focus: Focus) -> float:
    """Length of the contact's rim, mm: the perimeter of the zone.

    Where an oblong body lies askew, the zone's is longer than the body's by |cos| + |sin| of the angle between them.
    What a round rim has less, and a ring has twice, is in k.
    """
    perimeter = 4 * sum(focus.half_mm)
    if isinstance(indenter, Box) or _class_of(indenter) == "bar":
        angle = np.radians(indenter.rotation_deg[2])
        return float(perimeter / (abs(np.cos(angle)) + abs(np.sin(angle))))
    return perimeter


def _band(indenter: Indenter, focus: Focus, depth_mm: float) -> float:
    """Half width of the band that touches, mm: of a chord of a round surface, d deep, at most the surface's radius."""
    match indenter:
        case Sphere():
            radius = indenter.radius_mm
        case Cylinder():
            fillet = indenter.fillet_mm or DEFAULT_FILLET_MM
            radius = indenter.radius_mm if _class_of(indenter) == "bar" else fillet
        case Box():
            radius = indenter.fillet_mm or DEFAULT_FILLET_MM
        case Torus():
            radius = indenter.tube_mm
        case Cone() | MeshIndenter():  # a cone's is its contact's radius; of a mesh nothing is known but the zone
            return max(min(focus.half_mm), 1e-3)
    depth_mm = min(depth_mm, radius)
    return float(np.sqrt(depth_mm * (2 * radius - depth_mm)))
