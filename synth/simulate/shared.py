"""The mesh that all draws of a pad share where they are simulated many at once, and what it is expected to cost.

One mesh serves every draw of a batch, wherever its indenter touches: it is even along x and y, `numerics.cells` says
how fine, and graded through the thickness so that elements at the contact face are about as high as wide. Each draw has
a predicted error of its own, by `synth.simulate.error_model`, which was fitted to meshes graded around the contact:
here it extrapolates.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from synth.mesh import Counts, Focus, PadMesh, domed, graded_box
from synth.scene import Gel, Numerics, Scene
from synth.simulate.footprint import footprint
from synth.simulate.load_path import path_of
from synth.simulate.resolution import MARGIN, depth_growth, element_size, predicted_error_px


@dataclass(frozen=True)
class Accuracy:
    """How well a mesh resolves one draw.

    Attributes:
        across: whole elements across the contact, along its shorter side; 0 where less than one, and for an fTetWild
            mesh, whose elements are not counted.
        error_px: predicted root-mean-square error of the flow over the contact face; NaN for an fTetWild mesh.
    """

    across: int
    error_px: float


def shared_mesh(gel: Gel, numerics: Numerics) -> PadMesh:
    """The mesh of all draws of a pad; its Young's modulus does not enter."""
    layers = tuple(layer.thickness_mm for layer in gel.layers)
    return _even_mesh(gel.size_mm, gel.dome_radius_mm, layers, numerics.cells)


@lru_cache(maxsize=4)
def _even_mesh(
    size_mm: tuple[float, float, float],
    dome_radius_mm: float | None,
    layers_mm: tuple[float, ...],
    cells: tuple[int, int, int],
) -> PadMesh:
    """The structured mesh; kept, since a job asks for the same one again and again."""
    whole = Focus((0.0, 0.0), (size_mm[0] / 2, size_mm[1] / 2))
    counts = Counts((cells[0] - 2, cells[1] - 2), (1, 1), cells[2], growth=_growth(size_mm, cells))
    return domed(graded_box(size_mm, whole, counts, layers_mm), dome_radius_mm)


def _width(size_mm: tuple[float, float, float], cells: tuple[int, int, int]) -> float:
    """Of the elements, mm: geometric mean of both directions."""
    return float(np.sqrt(size_mm[0] / cells[0] * size_mm[1] / cells[1]))


def _growth(size_mm: tuple[float, float, float], cells: tuple[int, int, int]) -> float:
    return depth_growth(cells[2], size_mm[2] / _width(size_mm, cells))


def spacing_mm(gel: Gel, numerics: Numerics) -> float:
    """Size of the elements at the contact face as the error model takes it: see `synth.simulate.resolution`."""
    size, cells = gel.size_mm, numerics.cells
    wide, growth = _width(size, cells), _growth(size, cells)
    high = size[2] / sum(growth**k for k in range(cells[2]))
    return element_size(wide, high)


def accuracy(scene: Scene, folder: Path | None = None) -> Accuracy:
    """What the shared mesh gives for one draw; InputError where the indenter cannot be built."""
    gel, numerics = scene.sensor.gel, scene.numerics
    focus = footprint(path_of(scene, folder), gel.size_mm, MARGIN)
    error = predicted_error_px(scene, focus, spacing_mm(gel, numerics))
    return Accuracy(int(2 * min(focus.half_mm) / _width(gel.size_mm, numerics.cells)), error)
