r"""Structured tetrahedra of a box, fine in a zone of the contact face, as a function of that zone.

Every cell of a tensor grid is cut into six tetrahedra around its diagonal (Kuhn 1960), every other cell mirrored, so
that an even number of cells makes the mesh its own mirror image. What moves with the zone is only where the grid's
planes lie, never how many there are: all meshes of one `Counts` and pad have the same tetrahedra, and a solver
analyses their sparsity once.

Along x and y the spacing is f in the zone and f q, f q², ... beside it. With the number of elements continuous, a gap g
beside the zone takes

.. math::  n(g) = \ln(1 + g (q - 1) / (f q)) / \ln q

of them (the sum of the geometric series, solved for its length), and N elements in all fill a pad with a zone of
width w between gaps g₁ and g₂ to its edges where w/f + n(g₁) + n(g₂) = N. f = w / across gives q; where that q exceeds
STEEPEST, q = STEEPEST gives f (so few elements outside the zone leave it fewer than `across`); where it would be below
1, the spacing is even and the zone gets more. The zone's ends are planes of the grid where n(g₁) is whole, as for a
centred zone; elsewhere the element across an end is between f and f q long. Near an edge of the pad the elements of
one gap go to the other by themselves, and planes move continuously with the zone.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray, Tets
from synth.mesh.pad import PadMesh

STEEPEST = 2.5
"""Largest ratio q of the spacings beside the focus. Where an element lies across the focus's end, the ratio to its
neighbour is up to 1.1 q, see `tests/synth/test_mesh_graded.py`."""
FINEST = 0.04
"""Smallest spacing along x and y, relative to an even one."""
GRAIN_MM = 2.0**-32
"""Coordinates are multiples of it, but for the pad's faces and the layers' interfaces: the last bits of
`log` and `exp` differ between processors."""
FILM = 2
"""Fewest elements through each layer of a pad of several."""


@dataclass(frozen=True)
class Focus:
    """The zone to be resolved: an axis-parallel rectangle of the undeformed face, by its centre and half widths, mm.

    A half width of 0 is a line or a point.
    """

    centre_mm: tuple[float, float]
    half_mm: tuple[float, float]

    def span(self, axis: int, length_mm: float) -> tuple[float, float]:
        """Lower and upper end along an axis (0: x, 1: y), clipped to a pad of that length around the origin.

        A focus beyond the pad becomes the nearest edge, of no width.
        """
        centre, half, edge = self.centre_mm[axis], self.half_mm[axis], length_mm / 2
        return min(max(centre - half, -edge), edge), min(max(centre + half, -edge), edge)

    def clipped(self, size_mm: tuple[float, float, float]) -> "Focus":
        """The part of it that lies on a pad of that size."""
        (left, right), (top, bottom) = (self.span(axis, size_mm[axis]) for axis in (0, 1))
        return Focus(((left + right) / 2, (top + bottom) / 2), ((right - left) / 2, (bottom - top) / 2))


@dataclass(frozen=True)
class Counts:
    """Numbers of elements of a graded mesh.

    Attributes:
        across: elements across the focus along x and along y; even, so that a centred focus gives a symmetric mesh.
        outer: elements beside the focus on each side, along x and along y, where the focus is centred.
        through: elements through the thickness of a pad of one layer.
        growth: ratio of neighbouring spacings along z, from the contact face inward.
    """

    across: tuple[int, int] = (8, 8)
    outer: tuple[int, int] = (3, 2)
    through: int = 3
    growth: float = 1.3

    def cells(self, axis: int) -> int:
        """Elements along x (0) or y (1)."""
        return self.across[axis] + 2 * self.outer[axis]


def graded_box(
    size_mm: tuple[float, float, float], focus: Focus, counts: Counts, layers_mm: tuple[float, ...] = ()
) -> PadMesh:
    """Mesh a box whose elements are small under the focus, a zone of the contact face, cut off where the pad ends.

    Layers have their thicknesses from the contact face inward; the rest of size_mm[2] is one more. Equal counts,
    size_mm[2] and layers_mm give the same `tets` array. ValueError where layers are not positive or leave nothing of
    the thickness.
    """
    x, y = (lateral_planes(size_mm[axis], focus.span(axis, size_mm[axis]), counts, axis) for axis in (0, 1))
    z, layer = _depth_planes(size_mm[2], layers_mm, counts)
    cells = (len(x) - 1, len(y) - 1, len(z) - 1)
    points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    return PadMesh(points, kuhn_tets(*cells), size_mm, np.tile(np.repeat(layer, 6), cells[0] * cells[1]))


def spacing(length_mm: float, span_mm: tuple[float, float], counts: Counts, axis: int) -> tuple[float, float]:
    """Spacing in the focus (mm), and logarithm of the ratio of neighbouring spacings beside it, 0 to ln STEEPEST.

    `length_mm` is the pad's along an axis (0: x, 1: y), `span_mm` the lower and upper end of the focus, on the pad.
    """
    low, high = span_mm
    gaps, width, cells = (low + length_mm / 2, length_mm / 2 - high), high - low, counts.cells(axis)

    def excess(fine: float, rate: float) -> float:
        """Elements that this spacing needs beyond those there are."""
        return width / fine + sum(_elements(gap / fine, rate) for gap in gaps) - cells

    even, steepest = length_mm / cells, math.log(STEEPEST)
    fine = max(width / counts.across[axis], FINEST * even)
    if fine >= even:
        return even, 0.0
    if excess(fine, steepest) > 0:
        return _root(lambda f: -excess(f, steepest), fine, even), steepest
    return fine, _root(lambda rate: -excess(fine, rate), 0.0, steepest)


def lateral_planes(length_mm: float, span_mm: tuple[float, float], counts: Counts, axis: int) -> FloatArray:
    """(cells + 1,) coordinates along x or y, increasing from -length_mm / 2; arguments as for `spacing`.

    A span mirrored at the origin gives the mirror image to the bit.
    """
    fine, rate = spacing(length_mm, span_mm, counts, axis)
    (low, high), cells = span_mm, counts.cells(axis)
    number = np.arange(cells + 1, dtype=np.float64)
    # Positions in elements from either end of the focus, inward; each from its own side, so that mirroring is exact.
    right_of_low = number - _elements((low + length_mm / 2) / fine, rate)
    left_of_high = number[::-1] - _elements((length_mm / 2 - high) / fine, rate)
    total = right_of_low + left_of_high
    planes = np.where(total > 0, (left_of_high * low + right_of_low * high) / np.where(total > 0, total, 1.0), low)
    planes = np.where(right_of_low < 0, low - fine * _reach(-right_of_low, rate), planes)
    planes = np.where(left_of_high < 0, high + fine * _reach(-left_of_high, rate), planes)
    planes = _grained(planes)
    planes[0], planes[-1] = -length_mm / 2, length_mm / 2
    return planes


def _grained(lengths: FloatArray) -> FloatArray:
    return np.asarray(np.rint(lengths / GRAIN_MM) * GRAIN_MM)


def _elements(gap: float, rate: float) -> float:
    """Elements of lengths q, q^2, ... (q = e^rate) in a gap, as a continuous number; unit: the fine spacing."""
    return gap if rate == 0 else math.log1p(-gap * math.expm1(-rate)) / rate


def _reach(elements: FloatArray, rate: float) -> FloatArray:
    """Length of a number of elements: the inverse of `_elements`, 0 where there are none."""
    elements = np.maximum(elements, 0.0)
    return elements if rate == 0 else np.asarray(-np.expm1(rate * elements) / math.expm1(-rate))


def _root(rising: Callable[[float], float], low: float, high: float) -> float:
    """The zero of an increasing function, by halving to the last bit."""
    while True:
        middle = (low + high) / 2
        if middle in (low, high):
            return high
        if rising(middle) < 0:
            low = middle
        else:
            high = middle


def _depth_planes(
    thickness: float, layers_mm: tuple[float, ...], counts: Counts
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Coordinates (k + 1,) along z and the layer (k,) of each spacing."""
    interfaces = np.concatenate([[0.0], np.cumsum(layers_mm), [thickness]])
    if not (np.diff(interfaces) > 0).all():
        raise ValueError(f"layers of {layers_mm} mm must be positive and thinner together than the pad's {thickness}")
    rate = math.log(counts.growth)
    first = thickness / float(_reach(np.full(1, float(counts.through)), rate)[0])
    place = np.array([_elements(float(z) / first, rate) for z in interfaces])
    # Each layer has at least as many elements as the grading of the whole thickness would give it.
    number = np.maximum(np.ceil(np.diff(place) - 1e-9).astype(int), FILM if layers_mm else 1)
    planes = [np.zeros(1)]
    for k, elements in enumerate(number):
        numbers = np.linspace(place[k], place[k + 1], elements + 1, dtype=np.float64)[1:]
        planes.append(_grained(first * _reach(numbers, rate)))
        planes[-1][-1] = interfaces[k + 1]
    return np.concatenate(planes), np.repeat(np.arange(len(number), dtype=np.int32), number)


@functools.cache
def kuhn_tets(nx: int, ny: int, nz: int) -> Tets:
    """(6 nx ny nz, 4) int32, read-only: tetrahedra of a grid of nx x ny x nz cells, positive for increasing axes.

    Node (i, j, k) of the grid is number (i (ny + 1) + j) (nz + 1) + k. The order is such that the tetrahedra of one
    cell column lie together: index = 6 (cell number) + (one of its six), cells numbered alike with nx, ny, nz.
    """
    cells = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), np.arange(nz), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    odd = cells % 2 == 1
    mirrored = odd.sum(axis=(1, 2)) % 2 == 1
    tets = []
    for order in permutations(range(3)):
        steps = np.zeros((4, 3), dtype=int)
        for step, axis in enumerate(order):
            steps[step + 1 :, axis] = 1
        corners = cells + np.where(odd, 1 - steps, steps)
        tet = (corners[..., 0] * (ny + 1) + corners[..., 1]) * (nz + 1) + corners[..., 2]
        # An odd permutation of the axes turns the tetrahedron over, and so does each mirroring of the cell.
        turned = mirrored ^ (sum(a > b for a, b in zip(order, order[1:] + order[:1], strict=True)) == 2)
        tets.append(np.where(turned[:, None], tet[:, [0, 2, 1, 3]], tet))
    joined = np.stack(tets, axis=1).reshape(-1, 4).astype(np.int32)
    joined.setflags(write=False)
    return joined
