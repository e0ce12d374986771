"""The rigid body of a scene: packed shape, orientation, and how far it reaches toward the gel.

Frame of an indenter: its own +z points at the gel. Balls, bars, blocks and rings have their origin at their centre, a
cone at the centre of its rounded tip, a mesh at the centre of its bounding box.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.press.distance import KINDS, SHAPE_LENGTH
from synth.press.object_grid import Grid
from synth.scene import Box, Cone, Cylinder, Indenter, MeshIndenter, Sphere, Torus, Vector3
from synth.scene.indenter import DEFAULT_FILLET_MM
from synth.scene.surface_file import Triangles, read_surface

BLUNT_MM = 1.0
"""Smallest radius at which the contact stiffness of `numerics.penalty` is enough."""
SHARPEST = 4.0
"""Largest factor on the contact stiffness."""
OBJECT_STIFFNESS = 2.0
"""A mesh's contact stiffness over that of analytic shapes of its radius: its edges and corners bear on few contact
points."""
OBJECT_RADIUS = 2.0
"""A mesh's smallest radius over the smallest that the gel's mesh resolves: the distance of its contact points."""
LOWERED = 0.25
"""Depth counts from the lowest point of a mesh as its file has it, although the gel's mesh makes rounding take that
off. By this share of what it takes the body is lowered: a coarse mesh of the gel bears on edges with too much force, a
rounded edge with too little (docs/reports/objects.md). An edge that is rounded on request counts from its own end."""
MOST_RAISED = 0.3
"""Most of the depth that may be lost so, on meshes too coarse for the contact."""
LARGEST_GRID = 4_000_000
"""Points of a mesh's distance grid (32 MB)."""
USUAL_GRID = 250_000
"""Points that a grid has at most by default, where no radius is stated."""
MOST_MISSING = 1 / 3
"""Largest share of a closed surface that is made up where a file has holes: half a sphere lacks a quarter."""
TIP_MM = 0.05  # points that are at most so much higher than a mesh's lowest belong to its tip
CELLS_PER_RADIUS = 2.5
"""Spacings of the grid to the radius of the edges; more keep tips sharper, and take longer."""


@dataclass(frozen=True)
class Touchable:
    """The part of a body that a gel can touch in a press of a depth, or within a box.

    The radius is about the body's axis along z, through its origin; the height is from its lowest point, the one that
    is nearest to the gel. On a round gel, which recedes beside the place, that point comes down `at_tip`: on the axis.
    A box, (2, 3) lower and upper corner in the body's axes, says that poses are of the body's own frame: the origin of
    a mesh is its file's.
    """

    radius_mm: float = np.inf
    height_mm: float = np.inf
    depth_mm: float = np.inf
    at_tip: bool = False
    box: FloatArray | None = None


EVERYTHING = Touchable()
KIND_NAMES = {number: name for name, number in KINDS.items()}


@dataclass(frozen=True)
class RigidBody:
    """An indenter ready for the kernels.

    Attributes:
        kind: number of its shape.
        shape: (SHAPE_LENGTH,) lengths as `synth.press.distance.signed_distance` wants them.
        rotation: (3, 3) its axes as columns, before any twist.
        reach_mm: from its origin along +z to where the depth of a press counts from; of a mesh see LOWERED.
        coefficients: (i, j, k) B-spline coefficients of a mesh's distance grid, else (1, 1, 1) zeros.
        sharpest_mm: its smallest radius of curvature: fillet, tip, tube or, of a mesh, the cell of its grid.
        fillet_mm: radius that its edges have; 0 for shapes without edges.
        lost_mm: how far a mesh's surface is moved by rounding, at most, within the depth of the press.
        corners: (k, 3) vertices of a mesh's convex hull; none of other shapes.
    """

    kind: int
    shape: FloatArray
    rotation: FloatArray
    reach_mm: float
    coefficients: FloatArray
    sharpest_mm: float
    fillet_mm: float = 0.0
    lost_mm: float = 0.0
    corners: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def reach_along(self, direction: FloatArray) -> float:
        """How far it extends from its origin along a direction (3,), a unit vector in its axes: its support function.

        A mesh with its edges as sharp as its file has them.
        """
        radial, axial = float(np.hypot(direction[0], direction[1])), float(direction[2])
        rounding, *lengths = map(float, self.shape)
        match KIND_NAMES[self.kind]:
            case "sphere":
                reach = lengths[0]
            case "cylinder":
                reach = lengths[0] * radial + lengths[1] * abs(axial) + rounding
            case "box":
                reach = float(np.abs(direction) @ lengths[:3]) + rounding
            case "cone":
                reach = max(0.0, lengths[0] * radial - lengths[1] * axial) + rounding
            case "torus":
                reach = lengths[0] * radial + rounding
            case "mesh":
                return float((self.corners @ direction).max())
        return reach - float(self.shape[5:] @ direction)

    @property
    def sharpness(self) -> float:
        """Factor on the contact stiffness: 1 for blunt bodies, more for those with sharp edges.

        Where pressure of some E meets an edge, the gel must not sink in by as much as the edge's radius: the surface
        that it is held by, and the direction of the force, are lost there.
        """
        factor = OBJECT_STIFFNESS if self.kind == KINDS["mesh"] else 1.0
        return float(np.clip(factor * BLUNT_MM / self.sharpest_mm, 1.0, factor * SHARPEST))


def rotation_about(axis: int, angle: float) -> FloatArray:
    """(3, 3) rotation by `angle` (rad) from the next axis toward the one after it (z: from x to y)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix


def rigid_body(
    indenter: Indenter, folder: Path | None = None, resolution_mm: float = 0.0, touchable: Touchable = EVERYTHING
) -> RigidBody:
    """Pack an indenter, of which the part that is touchable matters; what a mesh has beyond is left out.

    Where no radius is stated, edges and tips that are sharper than `resolution_mm`, the smallest radius that the gel's
    mesh resolves, are rounded to it. A mesh indenter's relative file name is relative to the folder. InputError for a
    fillet or tube too large for its shape; a mesh file that is missing, no solid or too fine for a grid.
    """
    if isinstance(indenter, MeshIndenter):
        return _object(indenter, folder or Path(), resolution_mm, touchable)
    rotation = turned_by(indenter.rotation_deg)
    fillet = 0.0
    match indenter:
        case Sphere(radius_mm=radius):
            lengths, sharpest = [0.0, radius], radius
        case Cylinder(radius_mm=radius, length_mm=length):
            fillet = sharpest = _fillet(indenter, resolution_mm, min(radius, length / 2))
            core, half = radius - fillet, length / 2 - fillet
            lengths = [fillet, core, half]
        case Box(size_mm=size):
            fillet = sharpest = _fillet(indenter, resolution_mm, min(size) / 2)
            lengths = [fillet, *(np.array(size) / 2 - fillet)]
        case Cone(half_angle_deg=angle, height_mm=height):
            fillet = sharpest = _fillet(indenter, resolution_mm, height / 2)
            core = height - 2 * fillet
            lengths = [fillet, core * float(np.tan(np.radians(angle))), core]
        case Torus(radius_mm=radius, tube_mm=tube):
            _require(tube < radius, indenter, "tube_mm", f"less than radius_mm = {radius}")
            lengths, sharpest = [tube, radius], tube
    shape = np.zeros(SHAPE_LENGTH)
    shape[: len(lengths)] = lengths
    shape[5:] = rotation.T @ (rotation @ indenter.offset_mm * [1, 1, int(touchable.box is not None)])
    body = RigidBody(KINDS[indenter.shape], shape, rotation, 0.0, np.zeros((1, 1, 1)), sharpest, fillet)
    return replace(body, reach_mm=body.reach_along(rotation[2]))


def _fillet(indenter: Cylinder | Box | Cone, resolution: float, half_thickness: float) -> float:
    """The stated fillet, or the default one or a resolution, at most 90 % of what the body's thickness allows."""
    if indenter.fillet_mm is None:
        return min(max(DEFAULT_FILLET_MM, resolution), 0.9 * half_thickness)
    _require(indenter.fillet_mm < half_thickness, indenter, "fillet_mm", f"less than {half_thickness}")
    return indenter.fillet_mm


def _require(holds: bool, indenter: Indenter, field: str, allowed: str) -> None:
    if not holds:
        raise InputError(
            f"contact.indenter.{field} = {getattr(indenter, field)} does not fit this {indenter.shape}: "
            f"allowed is {allowed}"
        )


def _object(indenter: MeshIndenter, folder: Path, resolution_mm: float, touchable: Touchable) -> RigidBody:
    """A triangle mesh. It is turned before it is sampled, so that the grid holds the part that touches alone."""
    from scipy.ndimage import spline_filter
    from scipy.spatial import ConvexHull

    surface, origin = object_triangles(indenter, folder)
    if indenter.rotation_deg == "any":
        raise InputError('contact.indenter.rotation_deg = "any": draw a scene first; a body has three angles')
    rotation = turned_by(indenter.rotation_deg)
    turned = replace(surface, points=np.asarray(surface.points @ rotation.T))
    radius = object_radius(indenter, resolution_mm)
    lowest = turned.points.max(axis=0)[2]
    posed = touchable.box is not None
    match indenter.offset_mm or ("origin" if posed else "lowest" if touchable.at_tip else (0.0, 0.0, 0.0)):
        case "lowest":
            place = turned.points[turned.points[:, 2] > lowest - TIP_MM].mean(axis=0)
        case "origin":
            place = rotation @ origin
        case offset:
            place = rotation @ np.multiply(offset, [1, -1, 1])
    turned = replace(turned, points=turned.points - place * [1, 1, int(posed)])
    lowest = turned.points.max(axis=0)[2]
    grid = _grid_over(turned, indenter, radius, touchable)
    sharp, values = _rounded_distance(turned, grid, radius, f"contact.indenter.file = {indenter.file!r}")
    shape = np.array([0.0, *grid.corner, grid.spacing, *grid.counts])
    coefficients = np.asarray(spline_filter(values, order=3, mode="mirror"), dtype=np.float64)
    near = values < radius + grid.spacing
    reach = min(lowest, float((grid.points(near)[:, 2] - values[near]).max()))  # also of balls beside the solid
    kept = LOWERED if indenter.fillet_mm is None else 1.0
    reach = lowest - max(kept * (lowest - reach), lowest - reach - MOST_RAISED * touchable.depth_mm)
    corners = turned.points[turned.points[:, 2] >= lowest - touchable.depth_mm]
    corners = corners[np.abs(grid.at(corners, sharp)) < grid.spacing]  # not those of walls within the solid
    if touchable.box is not None:
        corners = corners[((corners >= touchable.box[0]) & (corners <= touchable.box[1])).all(axis=1)]
    lost = float(np.abs(grid.at(corners, values)).max(initial=0.0))
    hull = turned.points[ConvexHull(turned.points).vertices]
    sharpest = max(radius, grid.spacing)
    return RigidBody(KINDS["mesh"], shape, np.eye(3), reach, coefficients, sharpest, radius, lost, hull)


def _grid_over(turned: Triangles, indenter: MeshIndenter, radius: float, touchable: Touchable) -> Grid:
    """The grid over the part of a turned surface that is touchable; InputError for one of too many points."""
    low, high = turned.points.min(axis=0), turned.points.max(axis=0)
    low = np.maximum(low, [-touchable.radius_mm, -touchable.radius_mm, high[2] - touchable.height_mm])
    high = np.minimum(high, [touchable.radius_mm, touchable.radius_mm, np.inf])
    if touchable.box is not None:
        low, high = np.maximum(low, touchable.box[0]), np.minimum(high, touchable.box[1])
        if (low >= high).any():
            raise InputError(f"motion.poses: {indenter.file} never comes near the gel: are places and object in mm?")
    spacing = indenter.cell_mm or _spacing(radius, high - low, indenter.fillet_mm is not None)
    if indenter.fillet_mm is not None and spacing > radius:
        raise InputError(
            f"contact.indenter.fillet_mm = {radius:g}: {indenter.file} needs a grid with cells no larger, allowed are "
            f"{spacing:.2g} mm and more; state a larger radius or a smaller cell_mm, or press a smaller part"
        )
    margin = radius + 4 * spacing
    counts = np.ceil((high - low + 2 * margin) / spacing).astype(int) + 1
    if counts.prod() > LARGEST_GRID:
        raise InputError(
            f"contact.indenter.cell_mm = {spacing:g}: {indenter.file} needs {counts.prod()} grid points, more than "
            f"{LARGEST_GRID}; use a larger cell_mm"
        )
    return Grid(low - margin, spacing, (int(counts[0]), int(counts[1]), int(counts[2])))


def _rounded_distance(turned: Triangles, grid: Grid, radius: float, named: str) -> tuple[FloatArray, FloatArray]:
    """A surface's signed distance on a grid before and after rounding.

    InputError, beginning as `named`, where it is no solid.
    """
    values = grid.signed_distance(turned, radius)
    missing = 0.0 if turned.closed else grid.missing(values)
    if missing > MOST_MISSING:
        raise InputError(
            f"{named}: it is an open sheet, {missing:.0%} of a closed surface would have to be made up; give it a "
            "thickness"
        )
    values, boundary = grid.boundary(values, turned, radius)
    sharp = values
    if radius > 0:
        values = grid.rounded(values, boundary, radius)
    if not (values < 0).any():
        if turned.closed and (turned.points.min(axis=0) < grid.corner)[:2].any():
            raise InputError(
                f"{named}: only a hole or a hollow of it lies over the gel, or a wall thinner than {grid.spacing:.2g} "
                "mm; move it with motion.position_mm, or give another size_mm"
            )
        raise InputError(
            f"{named}: it encloses no volume that a grid of {grid.spacing:.2g} mm resolves; a single sheet needs a "
            "thickness"
        )
    return sharp, values


def object_radius(indenter: MeshIndenter, resolution_mm: float) -> float:
    """Radius, mm, that the edges of a mesh are rounded to: the stated one, or what the gel's mesh can follow."""
    return OBJECT_RADIUS * resolution_mm if indenter.fillet_mm is None else indenter.fillet_mm


def _spacing(radius_mm: float, extent_mm: FloatArray, stated: bool) -> float:
    """Spacing of a grid over an extent (3,): a share of the radius, coarser where that were too many points."""
    most = LARGEST_GRID / 2 if stated else USUAL_GRID  # the half: margins grow where the spacing does
    wanted = radius_mm / CELLS_PER_RADIUS if radius_mm > 0 else float(extent_mm.max()) / 80
    affordable = float((np.prod(extent_mm + 2 * radius_mm + 8 * wanted) / most) ** (1 / 3))
    return max(wanted, affordable)


def turned_by(rotation_deg: Vector3) -> FloatArray:
    """(3, 3) rotation by angles about x, then y, then z."""
    turns = [rotation_about(axis, np.radians(angle)) for axis, angle in enumerate(rotation_deg)]
    return turns[2] @ turns[1] @ turns[0]


SHORTEST_MM, LONGEST_MM = 0.5, 1000.0
"""Longest edges beyond which a file is taken to be in another unit."""


def object_triangles(indenter: MeshIndenter, folder: Path) -> tuple[Triangles, FloatArray]:
    """An object's surface in mm, not turned, its bounding box centred on the origin; and the file's origin (3,) then.

    The file is relative to `folder`. Files have right-handed axes; the scene's are left-handed, because y points down
    in the image. So y changes its sign: a letter can be read in the picture, a screw keeps its hand. InputError for a
    file that is missing or no surface, or of a size that speaks for another unit.
    """
    try:
        surface = read_surface(folder / indenter.file)
    except ValueError as error:
        raise InputError(f"contact.indenter.file = {indenter.file!r}: {error}") from None
    longest = float(np.ptp(surface.points, axis=0).max())
    scale = indenter.size_mm / longest if indenter.size_mm is not None else indenter.scale
    if not SHORTEST_MM <= scale * longest <= LONGEST_MM:
        if indenter.size_mm is not None:
            allowed = f"allowed are {SHORTEST_MM:g} to {LONGEST_MM:g}"
            raise InputError(f"contact.indenter.size_mm = {indenter.size_mm:g}: {allowed}")
        raise InputError(
            f"contact.indenter.scale = {scale:g}: {indenter.file} is then {scale * longest:.3g} mm long. Is it in "
            "metres (scale = 1000), inches (25.4) or, as a GLB, in mm (0.001)? size_mm gives its longest edge instead"
        )
    centre = (surface.points.min(axis=0) + surface.points.max(axis=0)) / 2
    moved = scale * (np.concatenate([surface.points, np.zeros((1, 3))]) - centre) * [1, -1, 1]
    return Triangles(moved[:-1], surface.faces[:, ::-1], surface.closed), moved[-1]
