r"""The error that a mesh is expected to leave in the displacement of the contact face.

A press of P2/P1 elements errs where the contact ends: pressure and friction end in kinks there. With h the size of the
elements under the contact and l the length of its rim, and u and r the mesh's displacement and the exact one,

.. math::  E = \sqrt{\int |u - r|^2 dA} = c k \sqrt{l / b} \sqrt{d m} \, T^{-0.6} h^{1.6},
           \qquad m = d + \sqrt{\min(\mu, 1)} \max (2 |s| + w |\theta|)

in mm², lengths in mm: d press depth, b half width of the band that touches at that depth (so that d / b is how steeply
the indenter's surface meets the gel), T thickness of the pad, s shear, theta twist in rad, w larger half width of the
zone, mu friction, k a number for each shape of indenter and c a factor for certainty. The powers of the lengths add up
to two: a press of twice the size errs by twice as much, on the same mesh of twice the size.

Relative to the displacement of the face, which is about 2 g a √(d² + ((m - d) / 2)²) in L2, the error is

.. math::  e = \frac{c \, (T / a)^{0.35} \, E}{2 g a \sqrt{d^2 + ((m - d) / 2)^2}}

with a the zone's half width (geometric mean of its two), and g a number for each shape. E is of what a camera sees of
presses with friction; without friction, and with z, the error of small contacts is larger by the power of T / a. The
relative error of the contact force was half of the displacement's in the mean; where elements are wider than an edge's
band, about the same. e stands for both.

The powers were set by hand near those of free fits, which predict other trajectories hardly better; k was fitted
(docs/reports/budget.md). Covered are flat pads of 2.5 to 16 mm and a dome, depths to 40 % of the thickness, friction of
0.3 to 1, elements 0.4 to 2.7 b wide; all but one of the pads are incompressible. e was fitted to fewer presses
(docs/reports/force_budget.md).
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
DISPLACED = {"sphere": 0.6, "cone": 0.6, "bar": 0.6, "punch": 0.9, "box": 0.9, "torus": 0.3, "mesh": 0.3}
"""g of the error model: how much of the zone an indenter carries along. Of a mesh it is the least of the others."""
RELATIVE = 1.8
"""c of the relative error, a third above the mean: a budget should hold for most presses, not for half."""


def face_error(scene: Scene, focus: Focus, spacing_mm: float) -> float:
    """E of the error model, mm², of an instance that touches at a focus; 0 for an indenter that does not touch.

    `spacing_mm` is the size of the elements under the contact, as `synth.press.resolution` has it.
    """
    indenter = scene.contact.indenter
    depth, drag = _moves(scene, focus)
    if depth <= 0:
        return 0.0
    moved = depth + drag
    rim, band = _rim(indenter, focus), _band(indenter, focus, depth)
    scale = CERTAINTY * ERROR_SCALES[_class_of(indenter)] * scene.sensor.gel.size_mm[2] ** -0.6
    return float(scale * np.sqrt(rim / band * depth * moved) * spacing_mm**RATE)


def error_percent(scene: Scene, focus: Focus, spacing_mm: float) -> float:
    """Error of force and displacement in percent, e of the model, with the arguments of `face_error`.

    NaN for P1/P1 elements, for which nothing is known.
    """
    if scene.numerics.element == "p1p1":
        return float("nan")
    depth, drag = _moves(scene, focus)
    if depth <= 0:
        return 0.0
    half = np.sqrt(np.prod(focus.half_mm))
    moved = DISPLACED[_class_of(scene.contact.indenter)] * 2 * half * np.hypot(depth, drag / 2)
    small = (scene.sensor.gel.size_mm[2] / half) ** 0.35
    return float(100 * RELATIVE * small * face_error(scene, focus, spacing_mm) / moved)


def _moves(scene: Scene, focus: Focus) -> tuple[float, float]:
    """Depth d of the press and what friction drags the gel, m - d of the module, mm."""
    poses = scene.motion.stops.values()
    width = max(focus.half_mm)
    drag = max(2 * np.hypot(*pose.shear_mm) + width * abs(np.radians(pose.twist_deg)) for pose in poses)
    return max(pose.depth_mm for pose in poses), float(np.sqrt(min(scene.contact.friction, 1.0)) * drag)


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
