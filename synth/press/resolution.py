"""Which mesh a trajectory is simulated on: as fine under its contact as its error budget asks for.

The mesh is structured and graded around where its indenter will touch: `across` elements across the contact,
as many through the thickness as keep elements under the contact about as high as wide. It is the cheapest mesh whose
predicted errors are within the budgets, of the flow in px and, where one is set, of force and displacement in percent;
the predictions (`synth.press.error_model`) were calibrated, and are tested, against much finer solutions
(docs/reports/budget.md).

Draws of a pad that are simulated many at once share one mesh, wherever their indenters touch: it is even along x and y,
`numerics.cells` says how fine, and graded through the thickness so that elements at the contact face are about as high
as wide. Each trajectory has a predicted error of its own, calibrated on meshes graded around the contact: it
extrapolates.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from synth.mesh import Counts, Focus, PadMesh, domed, graded_box
from synth.mesh.element import Element, p1p1, p2p1
from synth.mesh.face import face_height
from synth.mesh.graded import spacing
from synth.optics import Optics
from synth.press.error_model import error_percent, face_error
from synth.press.footprint import footprint
from synth.press.posed_path import PosedPath
from synth.press.scene_path import path_of
from synth.scene import Gel, MeshIndenter, Numerics, Scene

ELEMENTS_ACROSS = (4, 6, 8, 10, 12, 14, 16)
"""Elements across the contact to choose from."""
FINER = (20, 24, 28, 32, 40)
"""More of them, for a stated `fillet_mm` or a target in percent alone: they take minutes."""
CONTACT_ACROSS = 12
"""Fewest elements across the contact where outputs.contact or slip asks for its edge."""
ELEMENTS: dict[str, Callable[[], Element]] = {"auto": p2p1, "p1p1": p1p1, "p2p1": p2p1}
TALLEST = 1.8
"""Largest height over width of the elements under the contact."""
WORTHWHILE = 0.97
"""A mesh level has elements of at most this share of the size of any that costs less."""
MARGIN = -0.05
"""The zone ends a little inside the geometric footprint: the contact's rim then lies well within fine elements."""
STEEPEST_DEPTH = 2.2
"""Largest ratio of neighbouring spacings through the thickness."""
OUTER = (3, 2)
"""Elements beside a centred zone, on each side along x and along y."""


@dataclass(frozen=True)
class Accuracy:
    """How well a mesh resolves one trajectory, and the predicted errors: of the flow over the contact face, root mean
    square in px, and of force and displacement in percent (`synth.press.error_model.error_percent`).

    `across` are whole elements across the contact, along its shorter side; 0 where less than one. Of an fTetWild mesh
    elements are not counted, and the errors are NaN.
    """

    across: int
    error_px: float
    error_percent: float


@dataclass(frozen=True)
class Resolution(Accuracy):
    """A trajectory's mesh and what it is expected to cost in accuracy, with the size of the elements under the contact.

    `through` are the elements through the thickness, without those that layers add; 0 for an fTetWild mesh.
    """

    mesh: PadMesh
    through: int
    spacing_mm: float


class Fineness(NamedTuple):
    """Numbers of elements of a mesh: across the contact, and through the thickness (of a pad of one layer)."""

    across: int
    through: int


def mesh_levels(gel: Gel, focus: Focus, elements: Sequence[int] = ELEMENTS_ACROSS) -> list[Fineness]:
    """Meshes worth having for a zone, cheapest first; each is finer than all that cost less."""
    size = gel.size_mm
    found = []
    for number in elements:
        counts = Counts((number, number), OUTER)
        wide, fewest = lateral_spacing(gel, focus, counts), 2
        while size[2] / wide > TALLEST * _reach(fewest):
            fewest += 1
        for through in (fewest, fewest + 1):
            high = size[2] / _reach(through)
            cost = counts.cells(0) * counts.cells(1) * through
            found.append((cost, element_size(wide, high), Fineness(number, through)))
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
    """The structured mesh of a pad with `across` elements across a zone, and their size (see `element_size`).

    `across` is even; without `through`, as many elements go through the thickness as keep those under the zone no
    higher than wide.
    """
    size = gel.size_mm
    wide = lateral_spacing(gel, focus, Counts((across, across), OUTER))
    if through is None:
        through = 2
        while _reach(through) * wide < size[2]:
            through += 1
    growth = depth_growth(through, size[2] / wide)
    box = graded_box(size, focus, Counts((across, across), OUTER, through, growth), gel.layers_mm)
    return domed(box, gel.dome_radius_mm), element_size(wide, size[2] / _reach(through))


def lateral_spacing(gel: Gel, focus: Focus, counts: Counts) -> float:
    """Width of the elements in a zone, mm: geometric mean of the two directions."""
    size = gel.size_mm
    return float(np.sqrt(np.prod([spacing(size[k], focus.span(k, size[k]), counts, k)[0] for k in (0, 1)])))


def element_size(wide: float, high: float) -> float:
    """Size of elements under a contact for the error model: width, or its geometric mean with a larger height."""
    return float(np.sqrt(wide * max(wide, high)))


def _reach(through: int) -> float:
    """Largest thickness that `through` elements can fill when the first is 1 high."""
    return float(sum(STEEPEST_DEPTH**k for k in range(through)))


def depth_growth(through: int, height: float) -> float:
    """The growth with which `through` elements fill `height` when the first is 1; at most STEEPEST_DEPTH."""
    low, high = 1.0, STEEPEST_DEPTH
    for _ in range(40):
        middle = (low + high) / 2
        if sum(middle**k for k in range(through)) < height:
            low = middle
        else:
            high = middle
    return high


_FACE, _ZONE = (41, 33), (9, 9)
"""Points along x and y of the contact face, and of the zone, that stand for what the camera sees of them."""
_LEAST_SEEN = 0.1
"""Share of the error that is counted at least, however little of the zone the camera sees."""


def predicted_error_px(scene: Scene, focus: Focus, spacing_mm: float) -> float:
    r"""Root-mean-square error of the picture's flow, over the seen part of the contact face.

    .. math::  e = M E \sqrt{f / A}

    with E the error of the face (`face_error`, also for the arguments), M the magnification, A the seen area, and f the
    share of the zone that is seen, which is that of E² that counts.
    """
    size = scene.sensor.gel.size_mm[:2]
    face = _seen(scene, Focus((0.0, 0.0), (size[0] / 2, size[1] / 2)), _FACE) or 1.0  # where none is, all
    zone, area = max(_seen(scene, focus, _ZONE), _LEAST_SEEN), face * size[0] * size[1]
    return scale_px_per_mm(scene) * face_error(scene, focus, spacing_mm) * float(np.sqrt(zone / area))


def _seen(scene: Scene, part: Focus, counts: tuple[int, int]) -> float:
    """The share of a part of the undeformed contact face that is in the picture."""
    axes = [
        centre + half * (2 * np.arange(n) + 1 - n) / n
        for centre, half, n in zip(part.centre_mm, part.half_mm, counts, strict=True)
    ]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    optics = Optics.of(scene.sensor)
    points = np.column_stack([places, face_height(places, scene.sensor.gel.dome_radius_mm)])
    return float(optics.is_inside(optics.project(points)).mean())


def scale_px_per_mm(scene: Scene) -> float:
    """Magnification at the centre of the undeformed contact face: geometric mean of the two directions."""
    shift = 0.1
    corners = np.array([[0.0, 0.0, 0.0], [shift, 0.0, 0.0], [0.0, shift, 0.0]])
    pixels = Optics.of(scene.sensor).project(corners)
    u, v = (pixels[1:] - pixels[0]) / shift
    return float(np.sqrt(abs(u[0] * v[1] - u[1] * v[0])))


def resolution_mm(scene: Scene, spacing_mm: float) -> float:
    """Smallest radius of an indenter's edges that the contact points of a mesh resolve: half their distance."""
    return spacing_mm / (2 * ELEMENTS[scene.numerics.element]().order)


def _focus(scene: Scene, folder: Path | None) -> tuple[Focus, Scene]:
    """Where the indenter will touch, and the scene with a press in place of poses.

    A mesh is taken with its edges as sharp as its file has them, which takes less time.
    """
    whole = scene
    if isinstance(scene.contact.indenter, MeshIndenter):
        sharp = scene.contact.indenter.model_copy(update={"fillet_mm": None})
        scene = scene.model_copy(update={"contact": scene.contact.model_copy(update={"indenter": sharp})})
    path = path_of(scene, folder)
    if isinstance(path, PosedPath):
        whole = whole.model_copy(update={"motion": path.as_press()})
    return footprint(path, scene.sensor.gel.size_mm, MARGIN), whole


def resolve(
    scene: Scene, folder: Path | None, target_error_px: float, target_error_percent: float | None = None
) -> Resolution:
    """The cheapest graded mesh of a scene instance that is fine enough, else the finest.

    Its predicted errors are within both targets, it resolves a stated `fillet_mm`, and the contact's edge where that is
    asked for. InputError where the indenter, whose mesh file is relative to `folder`, or the mesh cannot be
    built.
    """
    gel = scene.sensor.gel
    focus, scene = _focus(scene, folder)
    stated = getattr(scene.contact.indenter, "fillet_mm", None)
    least = CONTACT_ACROSS if scene.outputs.contact or scene.outputs.slip else 0
    usual = mesh_levels(gel, focus)
    finer = [] if stated is None and target_error_percent is None else mesh_levels(gel, focus, FINER)
    for number, fineness in enumerate([*usual, *finer], 1):
        mesh, fine = graded_mesh(gel, focus, *fineness)
        error, percent = predicted_error_px(scene, focus, fine), error_percent(scene, focus, fine)
        enough = number >= len(usual) or (error <= target_error_px and fineness.across >= least)
        enough = enough and (target_error_percent is None or percent <= target_error_percent)
        if enough and (stated is None or resolution_mm(scene, mesh.spacing_mm) <= stated):
            break
    return Resolution(fineness.across, error, percent, mesh, fineness.through, fine)


def shared_mesh(gel: Gel, numerics: Numerics) -> PadMesh:
    """The mesh of all trajectories of a pad; its Young's modulus does not enter."""
    return _even_mesh(gel.size_mm, gel.dome_radius_mm, gel.layers_mm, numerics.cells)


@lru_cache(maxsize=4)
def _even_mesh(
    size_mm: tuple[float, float, float],
    dome_radius_mm: float | None,
    layers_mm: tuple[float, ...],
    cells: tuple[int, int, int],
) -> PadMesh:
    """The structured mesh; kept, since a job asks for the same one again and again."""
    whole = Focus((0.0, 0.0), (size_mm[0] / 2, size_mm[1] / 2))
    growth = depth_growth(cells[2], size_mm[2] / _width(size_mm, cells))
    counts = Counts((cells[0] - 2, cells[1] - 2), (1, 1), cells[2], growth)
    return domed(graded_box(size_mm, whole, counts, layers_mm), dome_radius_mm)


def _width(size_mm: tuple[float, float, float], cells: tuple[int, int, int]) -> float:
    """Width of the elements, mm: geometric mean of both directions."""
    return float(np.sqrt(size_mm[0] / cells[0] * size_mm[1] / cells[1]))


def shared_spacing_mm(gel: Gel, numerics: Numerics) -> float:
    """Size of the elements at the contact face as the error model takes it: see `element_size`."""
    size, cells = gel.size_mm, numerics.cells
    wide = _width(size, cells)
    growth = depth_growth(cells[2], size[2] / wide)
    return element_size(wide, size[2] / sum(growth**k for k in range(cells[2])))


def accuracy(scene: Scene, folder: Path | None = None) -> Accuracy:
    """What the shared mesh gives for one instance; InputError where the indenter cannot be built."""
    gel, numerics = scene.sensor.gel, scene.numerics
    focus, scene = _focus(scene, folder)
    spacing_mm = shared_spacing_mm(gel, numerics)
    across = int(2 * min(focus.half_mm) / _width(gel.size_mm, numerics.cells))
    errors = predicted_error_px(scene, focus, spacing_mm), error_percent(scene, focus, spacing_mm)
    return Accuracy(across, *errors)
