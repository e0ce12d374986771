"""Which mesh a draw is simulated on: as fine under its contact as its error budget asks for.

With `numerics.edge_length_mm` the mesh is fTetWild's, everywhere as fine as that says, the same for all draws of a pad.
Otherwise it is structured and graded around where the draw's indenter will touch: `across` elements across the contact,
as many through the thickness as keep elements under the contact about as high as wide. `across` comes from the error
model of `predicted_error_mm`, which was calibrated, and is tested, against much finer solutions (docs/reports/fem.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from synth.mesh import Counts, Focus, PadMesh, graded_box, pad_mesh
from synth.mesh.graded import spacing
from synth.optics import Optics
from synth.scene import Gel, Scene
from synth.scene_indenters import Cylinder, Indenter
from synth.simulate.footprint import footprint
from synth.simulate.indenter import rigid_body
from synth.simulate.path import Path

LADDER = (4, 6, 8, 10, 12, 14, 16)
"""Elements across the contact; a step costs about 1.5 times the one before."""
MARGIN = -0.05
"""The zone ends a little inside the geometric footprint: the contact's rim then lies well within fine elements."""
STEEPEST_DEPTH = 2.2
"""Largest ratio of neighbouring spacings through the thickness."""
OUTER = (3, 2)


@dataclass(frozen=True)
class Resolution:
    """A draw's mesh and what it is expected to cost in accuracy.

    Attributes:
        mesh: of the pad.
        across: elements across the contact; 0 for an fTetWild mesh.
        spacing_mm: edge length under the contact.
        error_px: predicted root-mean-square error of the flow over the contact face; NaN for an fTetWild mesh.
    """

    mesh: PadMesh
    across: int
    spacing_mm: float
    error_px: float


def graded_mesh(gel: Gel, focus: Focus, across: int) -> tuple[PadMesh, float]:
    """The structured mesh of a pad with so many elements across a zone, and their length (mm, geometric mean)."""
    size = gel.size_mm
    counts = Counts((across, across), OUTER)
    fine = float(np.sqrt(np.prod([spacing(size[k], focus.span(k, size[k]), counts, k)[0] for k in (0, 1)])))
    through, growth = _through(size[2] / fine)
    layers = tuple(layer.thickness_mm for layer in gel.layers)
    return graded_box(size, focus, Counts((across, across), OUTER, through, growth=growth), layers), fine


def _through(height: float) -> tuple[int, float]:
    """Elements through a thickness of `height` times the lateral spacing, and the growth that makes the first of 1."""
    through = 2
    while sum(STEEPEST_DEPTH**k for k in range(through)) < height:
        through += 1
    low, high = 1.0, STEEPEST_DEPTH
    for _ in range(40):
        middle = (low + high) / 2
        if sum(middle**k for k in range(through)) < height:
            low = middle
        else:
            high = middle
    return through, high


ERROR_SCALES = {"sphere": 0.096, "cone": 0.069, "bar": 0.164, "punch": 0.287, "box": 0.244, "torus": 0.27, "mesh": 0.3}
"""k of the error model; a bar is a cylinder that lies, a punch one that stands. Geometric means of 300 pairs of a draw
of the shipped scenes and a mesh against much finer solutions; the logarithm of measured over predicted scatters by
0.27. "mesh" was not measured: it is set as the worst of the others."""
CERTAINTY = 1.3
"""Factor on the model's mean. With it the error was below the target in 96 % of cases on draws that the model was not
fitted to, and the mesh cost at most twice the cheapest that would have done in 97 %."""
DEFAULT_TARGET_PX = 0.5


def predicted_error_mm(scene: Scene, focus: Focus, spacing_mm: float, seen_mm2: float) -> float:
    r"""Root-mean-square error of the surface's displacement over the seen part of the contact face.

    .. math::  e = 1.3 k h^{1.6} d^{0.5} m^{0.4} A^{-0.5}

    with lengths in mm: h spacing under the contact, d press depth, m depth and drag together, A seen area, k of the
    indenter's shape. For P2/P1 elements on `graded_mesh`; fitted to pads of 3.5 to 4.5 mm, depths to 40 % of the
    thickness and friction of 0.3 to 1, so that elsewhere it extrapolates.

    Args:
        scene: a draw.
        focus: where it touches.
        spacing_mm: edge length under the contact.
        seen_mm2: area over which the mean is taken.
    """
    motion = scene.motion
    poses = [(motion.depth_mm, motion.shear_mm, motion.twist_deg)]
    poses += [(pose.depth_mm, pose.shear_mm, pose.twist_deg) for pose in motion.then]
    depth = max(pose[0] for pose in poses)
    if depth <= 0:
        return 0.0
    arm = 0.7 * max(focus.half_mm)
    drag = max(np.hypot(*shear) + abs(np.radians(twist)) * arm for _, shear, twist in poses)
    scale = CERTAINTY * ERROR_SCALES[_class_of(scene.contact.indenter)]
    return float(scale * spacing_mm**1.6 * depth**0.5 * (depth + drag) ** 0.4 / np.sqrt(seen_mm2))


def _class_of(indenter: Indenter) -> str:
    if not isinstance(indenter, Cylinder):
        return indenter.shape
    tilted = np.hypot(np.sin(np.radians(indenter.rotation_deg[0])), np.sin(np.radians(indenter.rotation_deg[1])))
    return "bar" if tilted > 0.5 else "punch"


def scale_px_per_mm(scene: Scene) -> float:
    """Magnification at the centre of the undeformed contact face: geometric mean of the two directions."""
    shift = 0.1
    corners = np.array([[0.0, 0.0, 0.0], [shift, 0.0, 0.0], [0.0, shift, 0.0]])
    pixels = Optics.of(scene.sensor).project(corners)
    u, v = (pixels[1:] - pixels[0]) / shift
    return float(np.sqrt(abs(u[0] * v[1] - u[1] * v[0])))


def resolve(scene: Scene, folder: FilePath | None = None, mesh_folders: Sequence[FilePath] | None = None) -> Resolution:
    """The mesh of a draw.

    Args:
        scene: fully drawn.
        folder: what a mesh indenter's file name is relative to.
        mesh_folders: where fTetWild's meshes are kept.

    Raises:
        InputError: the indenter or the mesh cannot be built.
    """
    gel, numerics = scene.sensor.gel, scene.numerics
    if numerics.edge_length_mm is not None:
        mesh = pad_mesh(gel, numerics, mesh_folders)
        return Resolution(mesh, 0, numerics.edge_length_mm, float("nan"))
    focus = footprint(Path(scene.motion, rigid_body(scene.contact.indenter, folder)), gel.size_mm, MARGIN)
    target, scale = numerics.target_error_px or DEFAULT_TARGET_PX, scale_px_per_mm(scene)
    camera = scene.sensor.camera
    seen = min(camera.width * camera.height / scale**2, gel.size_mm[0] * gel.size_mm[1])
    for across in LADDER:
        mesh, fine = graded_mesh(gel, focus, across)
        error = scale * predicted_error_mm(scene, focus, fine, seen)
        if error <= target:
            break
    return Resolution(mesh, across, fine, error)
