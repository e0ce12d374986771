"""Which mesh a draw is simulated on: as fine under its contact as its error budget asks for.

With `numerics.edge_length_mm` the mesh is fTetWild's, everywhere as fine as that says, the same for all draws of a pad.
Otherwise it is structured and graded around where the draw's indenter will touch: `across` elements across the contact,
as many through the thickness as keep elements under the contact about as high as wide. Both come from the error model
of `predicted_error_mm`, which was calibrated, and is tested, against much finer solutions (docs/reports/budget.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np

from synth.mesh import Counts, Focus, PadMesh, domed, graded_box, pad_mesh
from synth.mesh.graded import spacing
from synth.optics import Optics
from synth.scene import Gel, Scene
from synth.scene_indenters import Cylinder, Indenter
from synth.simulate.footprint import footprint
from synth.simulate.indenter import rigid_body
from synth.simulate.path import Path

LADDER = (4, 6, 8, 10, 12, 14, 16)
"""Elements across the contact to choose from."""
TALLEST = 1.8
"""Largest height over width of the elements under the contact."""
WORTHWHILE = 0.97
"""A mesh of the ladder has elements of at most this share of the size of any that costs less."""
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
        through: elements through the thickness, without those that layers add; 0 for an fTetWild mesh.
        spacing_mm: size of the elements under the contact.
        error_px: predicted root-mean-square error of the flow over the contact face; NaN for an fTetWild mesh.
    """

    mesh: PadMesh
    across: int
    through: int
    spacing_mm: float
    error_px: float


class Fineness(NamedTuple):
    """Numbers of elements of a mesh: across the contact, and through the thickness (of a pad of one layer)."""

    across: int
    through: int

    def __str__(self) -> str:
        return f"{self.across}x{self.through}"

    @classmethod
    def of(cls, text: str) -> "Fineness":
        """From what `str` gives."""
        across, through = map(int, text.split("x"))
        return cls(across, through)


def ladder(gel: Gel, focus: Focus, across: Sequence[int] = LADDER) -> list[Fineness]:
    """Meshes worth having for a zone, cheapest first; each is finer than all that cost less.

    Args:
        gel: the pad.
        focus: the zone.
        across: elements across it to choose from.
    """
    size = gel.size_mm
    found = []
    for number in across:
        counts = Counts((number, number), OUTER)
        wide, fewest = lateral_spacing(gel, focus, counts), 2
        while size[2] / wide > TALLEST * _reach(fewest):
            fewest += 1
        for through in (fewest, fewest + 1):
            high = size[2] / _reach(through)
            cost = counts.cells(0) * counts.cells(1) * through
            found.append((cost, _spacing(wide, high), Fineness(number, through)))
            if high <= wide:
                break
    kept: list[Fineness] = []
    best = np.inf
    for _, spacing_mm, fineness in sorted(found):
        if spacing_mm < WORTHWHILE * best:
            kept.append(fineness)
            best = spacing_mm
    return kept


def graded_mesh(gel: Gel, focus: Focus, across: int, through: int | None = None) -> tuple[PadMesh, float]:
    """The structured mesh of a pad with so many elements across a zone, and their size (see `_spacing`).

    Args:
        gel: the pad.
        focus: the zone.
        across: elements across it, even.
        through: elements through the thickness; None for as many as keep those under the zone no higher than wide.
    """
    size = gel.size_mm
    wide = lateral_spacing(gel, focus, Counts((across, across), OUTER))
    if through is None:
        through = 2
        while _reach(through) * wide < size[2]:
            through += 1
    growth = depth_growth(through, size[2] / wide)
    layers = tuple(layer.thickness_mm for layer in gel.layers)
    box = graded_box(size, focus, Counts((across, across), OUTER, through, growth=growth), layers)
    return domed(box, gel.dome_radius_mm), _spacing(wide, size[2] / _reach(through))


def lateral_spacing(gel: Gel, focus: Focus, counts: Counts) -> float:
    """Width of the elements in a zone, mm: geometric mean of the two directions."""
    size = gel.size_mm
    return float(np.sqrt(np.prod([spacing(size[k], focus.span(k, size[k]), counts, k)[0] for k in (0, 1)])))


def _spacing(wide: float, high: float) -> float:
    """Size of the elements under a contact as the error model takes it: width, or where they are higher than wide the
    geometric mean of both. (A block's error on meshes 1.3, 1.7 and 2.1 times too high grew by 1.24, 1.58 and 1.78.)
    """
    return float(np.sqrt(wide * max(wide, high)))


def _reach(through: int) -> float:
    """Thickness that so many elements can fill when the first is 1 high."""
    return float(sum(STEEPEST_DEPTH**k for k in range(through)))


def depth_growth(through: int, height: float) -> float:
    """The growth with which so many elements fill `height` when the first is 1; at most STEEPEST_DEPTH."""
    low, high = 1.0, STEEPEST_DEPTH
    for _ in range(40):
        middle = (low + high) / 2
        if sum(middle**k for k in range(through)) < height:
            low = middle
        else:
            high = middle
    return high


ERROR_SCALES = {"sphere": 0.084, "cone": 0.061, "bar": 0.13, "punch": 0.212, "box": 0.17, "torus": 0.173, "mesh": 0.22}
"""k of the error model; a bar is a cylinder that lies, a punch one that stands. Fitted to 40 draws of two scenes on
five meshes each against finer ones (docs/reports/budget.md). Where a draw needs more than the coarsest mesh the
logarithm of measured over predicted scatters by 0.10, and by 0.15 for draws left out of the fit; over all of them by
0.24. "mesh" was not measured: it is set as the worst of the others."""
CERTAINTY = 1.2
"""Factor on the model's mean."""
DEFAULT_TARGET_PX = 0.5


def predicted_error_mm(scene: Scene, focus: Focus, spacing_mm: float, seen_mm2: float) -> float:
    r"""Root-mean-square error of the surface's displacement in the picture, over the seen part of the contact face.

    .. math::  e = 1.2 k h^{1.6} d^{0.55} m^{0.65} A^{-0.5}, \qquad m = d + \max (1.3 |s| + 1.7 w |\theta|)

    with lengths in mm: h size of the elements under the contact, d press depth, s shear, w larger half width of the
    zone, theta twist in rad, A seen area, k of the indenter's shape. For P2/P1 elements on `graded_mesh`; fitted to
    flat pads of 3.5 to 4.5 mm, depths to 40 % of the thickness and friction of 0.3 to 1: elsewhere it extrapolates.

    Args:
        scene: a draw.
        focus: where it touches.
        spacing_mm: size of the elements under the contact.
        seen_mm2: area over which the mean is taken.
    """
    motion = scene.motion
    poses = [(motion.depth_mm, motion.shear_mm, motion.twist_deg)]
    poses += [(pose.depth_mm, pose.shear_mm, pose.twist_deg) for pose in motion.then]
    depth = max(pose[0] for pose in poses)
    if depth <= 0:
        return 0.0
    width = max(focus.half_mm)
    drag = max(1.3 * np.hypot(*shear) + 1.7 * width * abs(np.radians(twist)) for _, shear, twist in poses)
    scale = CERTAINTY * ERROR_SCALES[_class_of(scene.contact.indenter)]
    return float(scale * spacing_mm**1.6 * depth**0.55 * (depth + drag) ** 0.65 / np.sqrt(seen_mm2))


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
        return Resolution(mesh, 0, 0, numerics.edge_length_mm, float("nan"))
    path = Path(scene.motion, rigid_body(scene.contact.indenter, folder), gel.dome_radius_mm)
    focus = footprint(path, gel.size_mm, MARGIN)
    target, scale = numerics.target_error_px or DEFAULT_TARGET_PX, scale_px_per_mm(scene)
    camera = scene.sensor.camera
    seen = min(camera.width * camera.height / scale**2, gel.size_mm[0] * gel.size_mm[1])
    for fineness in ladder(gel, focus):
        mesh, fine = graded_mesh(gel, focus, *fineness)
        error = scale * predicted_error_mm(scene, focus, fine, seen)
        if error <= target:
            break
    return Resolution(mesh, *fineness, fine, error)
