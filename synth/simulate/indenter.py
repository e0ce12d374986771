"""The rigid body of a scene: packed shape, orientation, and how far it reaches toward the gel.

Frame of an indenter: its own +z points at the gel. Balls, bars, blocks and rings have their origin at their centre, a
cone at the centre of its rounded tip, a mesh at the centre of its bounding box.
"""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.scene_indenters import Box, Cone, Cylinder, Indenter, MeshIndenter, Sphere, Torus
from synth.simulate.distance import KINDS, SHAPE_LENGTH

BLUNT_MM = 1.0
"""Smallest radius at which the contact stiffness of `numerics.penalty` is enough."""
SHARPEST = 4.0
LARGEST_GRID = 4_000_000
"""Cells of a mesh indenter's distance grid (32 MB)."""


@dataclass(frozen=True)
class RigidBody:
    """An indenter ready for the kernels.

    Attributes:
        kind: number of its shape.
        shape: (SHAPE_LENGTH,) lengths as `synth.simulate.distance.signed_distance` wants them.
        rotation: (3, 3) its axes as columns, before any twist.
        reach_mm: from its origin to its farthest point in +z, the point that touches first.
        coefficients: (i, j, k) B-spline coefficients of a mesh's distance grid, else (1, 1, 1) zeros.
        sharpest_mm: its smallest radius of curvature: fillet, tip, tube or, of a mesh, the cell of its grid.
    """

    kind: int
    shape: FloatArray
    rotation: FloatArray
    reach_mm: float
    coefficients: FloatArray
    sharpest_mm: float

    @property
    def sharpness(self) -> float:
        """Factor on the contact stiffness: 1 for blunt bodies, up to SHARPEST for those with sharp edges.

        Where pressure of some E meets an edge, the gel must not sink in by as much as the edge's radius: the surface
        that it is held by, and the direction of the force, are lost there. With the stiffness of blunt bodies a block
        of fillet 0.2 mm, 1.2 mm deep, sank in by 0.15 mm and lacked 8 % of its force; with four times that stiffness
        by 0.05 mm, and it lacked 1.5 %.
        """
        return float(np.clip(BLUNT_MM / self.sharpest_mm, 1.0, SHARPEST))


def rotation_about(axis: int, angle: float) -> FloatArray:
    """(3, 3) rotation by `angle` (rad) from the next axis toward the one after it (z: from x to y)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def rigid_body(indenter: Indenter, folder: Path | None = None, resolution_mm: float = 0.0) -> RigidBody:
    """Pack an indenter.

    Args:
        indenter: from the scene.
        resolution_mm: smallest radius that the gel's mesh resolves; sharper edges and tips are rounded to it.
        folder: what a mesh indenter's relative file name is relative to.

    Raises:
        InputError: a fillet or tube too large for its shape; a mesh file that is missing, open or too fine for a grid.
    """
    turns = [rotation_about(axis, np.radians(angle)) for axis, angle in enumerate(indenter.rotation_deg)]
    rotation = turns[2] @ turns[1] @ turns[0]
    up = rotation.T @ np.array([0.0, 0.0, 1.0])
    radial, axial = float(np.hypot(up[0], up[1])), float(up[2])
    coefficients = np.zeros((1, 1, 1))
    match indenter:
        case Sphere(radius_mm=radius):
            lengths, reach, sharpest = [0.0, radius], radius, radius
        case Cylinder(radius_mm=radius, length_mm=length, fillet_mm=fillet):
            _require(fillet < min(radius, length / 2), indenter, "fillet_mm", f"less than {min(radius, length / 2)}")
            fillet = _rounded(fillet, resolution_mm, min(radius, length / 2))
            sharpest = fillet
            core, half = radius - fillet, length / 2 - fillet
            lengths, reach = [fillet, core, half], core * radial + half * abs(axial) + fillet
        case Box(size_mm=size, fillet_mm=fillet):
            _require(fillet < min(size) / 2, indenter, "fillet_mm", f"less than {min(size) / 2}")
            fillet = _rounded(fillet, resolution_mm, min(size) / 2)
            sharpest = fillet
            half_edges = np.array(size) / 2 - fillet
            lengths, reach = [fillet, *half_edges], float(np.abs(up) @ half_edges) + fillet
        case Cone(half_angle_deg=angle, height_mm=height, fillet_mm=fillet):
            _require(2 * fillet < height, indenter, "fillet_mm", f"less than {height / 2}")
            fillet = _rounded(fillet, resolution_mm, height / 2)
            sharpest = fillet
            core = height - 2 * fillet
            base = core * float(np.tan(np.radians(angle)))
            lengths, reach = [fillet, base, core], max(0.0, base * radial - core * axial) + fillet
        case Torus(radius_mm=radius, tube_mm=tube):
            _require(tube < radius, indenter, "tube_mm", f"less than radius_mm = {radius}")
            lengths, reach, sharpest = [tube, radius], radius * radial + tube, tube
        case MeshIndenter():
            corner, vertices, coefficients = _distance_grid(indenter, folder or Path())
            lengths = [0.0, *corner, indenter.cell_mm, *coefficients.shape]
            reach, sharpest = float((vertices @ up).max()), indenter.cell_mm
    shape = np.zeros(SHAPE_LENGTH)
    shape[: len(lengths)] = lengths
    return RigidBody(KINDS[indenter.shape], shape, rotation, reach, coefficients, sharpest)


def _rounded(fillet: float, resolution: float, half_thickness: float) -> float:
    """The fillet that is simulated; at most 90 % of what the body's thickness allows."""
    return max(fillet, min(resolution, 0.9 * half_thickness))


def _require(holds: bool, indenter: Indenter, field: str, allowed: str) -> None:
    if not holds:
        raise InputError(
            f"contact.indenter.{field} = {getattr(indenter, field)} does not fit this {indenter.shape}: "
            f"allowed is {allowed}"
        )


@contextmanager
def _silence() -> Iterator[None]:
    """Without VTK's log and warnings, which tell of addresses and reference counts."""
    disabled = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(disabled)


def _distance_grid(indenter: MeshIndenter, folder: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corner of the grid (3,), vertices (n, 3) about the box's centre, B-spline coefficients (i, j, k)."""
    import pyvista as pv
    from scipy.ndimage import spline_filter

    path = Path(indenter.file) if Path(indenter.file).is_absolute() else folder / indenter.file
    if not path.is_file():
        raise InputError(f"contact.indenter.file = {indenter.file!r}: there is no file {path}")
    try:
        with _silence():
            surface = pv.read(path).extract_surface(algorithm=None).triangulate().clean()
    except (ValueError, OSError, AttributeError) as error:
        raise InputError(
            f"contact.indenter.file = {indenter.file!r}: pyvista cannot read it as a surface ({error})"
        ) from error
    if surface.n_cells == 0:
        raise InputError(
            f"contact.indenter.file = {indenter.file!r}: cannot be read as a surface; the file is damaged or empty"
        )
    if surface.n_open_edges > 0:
        raise InputError(
            f"contact.indenter.file = {indenter.file!r}: the surface must be closed; "
            f"it has {surface.n_cells} triangles and {surface.n_open_edges} open edges"
        )
    surface.points = np.asarray(surface.points, dtype=np.float64) * indenter.scale
    surface.points -= (surface.points.min(axis=0) + surface.points.max(axis=0)) / 2
    # The sign of the distance follows the triangles' orientation, which files get wrong.
    surface = surface.compute_normals(auto_orient_normals=True, consistent_normals=True, split_vertices=False)
    vertices = np.asarray(surface.points, dtype=np.float64)
    pad = 4 * indenter.cell_mm
    corner = vertices.min(axis=0) - pad
    counts = np.ceil((vertices.max(axis=0) + pad - corner) / indenter.cell_mm).astype(int) + 1
    if counts.prod() > LARGEST_GRID:
        raise InputError(
            f"contact.indenter.cell_mm = {indenter.cell_mm}: a {vertices.max(axis=0) - vertices.min(axis=0)} mm mesh "
            f"needs {counts.prod()} grid points, more than {LARGEST_GRID}; use a larger cell_mm or cut away what never "
            "touches"
        )
    grid = pv.ImageData(dimensions=counts, spacing=(indenter.cell_mm,) * 3, origin=corner)
    distance = grid.compute_implicit_distance(surface)["implicit_distance"]
    values = np.asarray(distance, dtype=np.float64).reshape(tuple(counts), order="F")
    return corner, vertices, np.asarray(spline_filter(values, order=3, mode="mirror"), dtype=np.float64)
