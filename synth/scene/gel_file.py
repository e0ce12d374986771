"""Gels from CAD files: two closed surfaces, read, checked and brought into the sensor's frame.

The gel is what lies inside `outer` and outside `window`. Both are turned as the scene says, and moved so that outer's
bounding box is centred in x and y and begins at z = 0; y changes its sign, because files have right-handed axes and the
frame is left-handed.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Points
from synth.scene.gel import LARGEST_MM
from synth.scene.part import Vector3
from synth.scene.surface_file import Triangles, read_surface

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
SHORTEST_MM, LONGEST_MM = 2.0, LARGEST_MM
"""Longest edges of bounding boxes beyond which a file is taken to be in another unit."""
CONTACT = 2e-3
"""Outer and window touch where they are nearer than this share of outer's longest edge."""
SHARP_DEG = 40.0
"""The coated face ends at edges that are sharper."""
SAMPLES = 300
"""Triangles at which a gel's thickness is measured."""
QUARTER_TURNS: tuple[Vector3, ...] = ((0, 0, 0), (180, 0, 0), (90, 0, 0), (-90, 0, 0), (0, 90, 0), (0, -90, 0))
"""Rotations that bring each of the files' axes to point down."""


@dataclass(frozen=True, eq=False)
class GelSurfaces:
    """Surfaces in the sensor's frame, mm, as pyvista's PolyData with triangles whose normals point out of the bodies.

    `face` is of outer what no sharp edge parts from its point on the axis: what is coated; `rest` what is neither
    coated, nor on the window, nor in the plane of its largest z, where it is cut.
    """

    outer: Any
    window: Any
    face: Any
    rest: Any

    @property
    def size_mm(self) -> tuple[float, float, float]:
        x, y, z = (round(float(edge), 6) for edge in np.ptp(self.outer.points, axis=0))
        return x, y, z

    @property
    def top_mm(self) -> float:
        """Z of the plane in which the gel is cut."""
        return float(self.outer.points[:, 2].max())

    @property
    def thickness_mm(self) -> float:
        """Thickness of the gel along z on the axis; NaN where there is no gel below the window."""
        axis = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 2 * self.top_mm]])
        face, window = (body.ray_trace(*axis)[0][:, 2] for body in (self.face, self.window))
        return round(float(window.min() - face.min()), 6) if len(face) and len(window) else float("nan")

    def thinnest(self) -> tuple[float, Points]:
        """Least distance mm from the face to the window along normals, and the point (3,) mm of the face where it is.

        Infinite where no normal meets the window.
        """
        centres, normals = self.face.cell_centers().points, self.face.face_normals
        found = [(float("inf"), np.zeros(3))]
        apart = np.flatnonzero(distance(self.window, centres) > CONTACT * max(self.size_mm))
        picked = apart[:: 1 + len(apart) // SAMPLES]
        for centre, normal in zip(centres[picked], normals[picked], strict=True):
            hits = self.window.ray_trace(centre, centre - 2 * LONGEST_MM * normal)[0]
            if len(hits):
                found.append((float(np.linalg.norm(hits - centre, axis=1).min()), centre))
        return min(found, key=lambda place: place[0])


def gel_surfaces(outer: Path, window: Path, unit: str, rotation_deg: Vector3 = (0.0, 0.0, 0.0)) -> GelSurfaces:
    """Read both files; ValueError says in a sentence what is wrong with one of them."""
    changed = [path.stat().st_mtime_ns for path in (outer, window) if path.is_file()]
    return _checked(outer, window, unit, rotation_deg, *changed)


def in_frame(points: Points, rotation_deg: Vector3) -> Points:
    """Points (n, 3) mm of a file turned in its right-handed axes, then mirrored into the frame's left-handed ones."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix().round(15)
    return np.asarray(points @ turn.T * [1, -1, 1])


def measured(value: Any, folder: Path) -> Any:
    """A JSON-able part of a scene, where gels from files have what follows from them: size, thickness and digest.

    The files are relative to `folder`; ValueError where one is not fit for a gel, or the part gives another size.
    """
    if isinstance(value, list):
        return [measured(inner, folder) for inner in value]
    if not isinstance(value, dict):
        return value
    match value:
        case {"shape": "file", "outer": str(outer), "window": str(window), "unit": str(unit)} if unit in UNITS_MM:
            files = folder / outer, folder / window
            rotation = value.get("rotation_deg", [0.0, 0.0, 0.0])
            if not isinstance(rotation, list) or [type(angle) in (int, float) for angle in rotation] != [True] * 3:
                raise ValueError(f"rotation_deg = {rotation!r}: must be three fixed angles")
            x, y, z = turn = tuple(map(float, rotation))
            surfaces = gel_surfaces(*files, unit, (x, y, z))
            digest = hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files))
            digest.update(repr(turn).encode() if any(turn) else b"")
            follows = {"size_mm": list(surfaces.size_mm), "thickness_mm": surfaces.thickness_mm}
            for name, found in follows.items():
                if value.get(name, found) != found:
                    raise ValueError(f"{name} = {value[name]}: the files say {found}; leave it out")
            return {**value, **follows, "digest": digest.hexdigest()[:16]}
    return {name: measured(inner, folder) for name, inner in value.items()}


def nearest(surface: Any, points: Points) -> Points:
    """(n, 3) points of a surface that are nearest to others."""
    if len(points) == 0 or surface.n_cells == 0:
        return np.full_like(points, np.inf)
    return np.asarray(surface.find_closest_cell(points, return_closest_point=True)[1], float).reshape(-1, 3)


def distance(surface: Any, points: Points) -> FloatArray:
    """(n,) mm from points (n, 3) to a surface."""
    return np.asarray(np.linalg.norm(points - nearest(surface, points), axis=1))


@lru_cache(maxsize=8)
def _checked(outer: Path, window: Path, unit: str, rotation_deg: Vector3, *changed_ns: int) -> GelSurfaces:
    import pyvista as pv

    bodies = _solid("outer", outer, unit), _solid("window", window, unit)
    solid, support = _placed(*bodies, rotation_deg)
    near = CONTACT * float(np.ptp(solid.points, axis=0).max())
    points, faces = solid.points, solid.regular_faces
    hits, cells = solid.ray_trace([0.0, 0.0, -1.0], [0.0, 0.0, points[:, 2].max() + 1])
    if len(hits) == 0:
        raise ValueError(f"outer = {outer.name!r} has no face on its axis")
    parted = solid.compute_normals(split_vertices=True, feature_angle=SHARP_DEG, consistent_normals=False)
    region = parted.connectivity("all").cell_data["RegionId"]
    coated = region == region[cells[hits[:, 2].argmin()]]
    apart = (points[:, 2] < points[:, 2].max() - 1e-6) & (distance(support, points) > near)
    parts = coated, ~coated & apart[faces].any(axis=1)
    found = GelSurfaces(solid, support, *(pv.PolyData.from_regular_faces(points, faces[part]) for part in parts))
    thickness = found.thickness_mm
    upright = () if _looks_down(solid, support) else (t for t in QUARTER_TURNS if _looks_down(*_placed(*bodies, t)))
    turn = next(iter(upright), None)
    advice = "" if turn is None else f"; rotation_deg = {list(turn)} turns its face, or tip, toward the lowest z"
    if not thickness <= hits[:, 2].max() + near:
        raise ValueError(
            f"window = {window.name!r} lies outside of outer = {outer.name!r}: it holds no gel on the axis{advice}"
        )
    if thickness <= near:
        raise ValueError(f"window = {window.name!r} reaches through the gel at the middle of its face{advice}")
    if advice:
        raise ValueError(f"outer = {outer.name!r} has gel above the window, where the camera is: it lies askew{advice}")
    return found


def _placed(outer: Triangles, window: Triangles, rotation_deg: Vector3) -> tuple[Any, Any]:
    """Both bodies, turned, with outer's bounding box at z = 0 and centred, as PolyData."""
    import pyvista as pv

    points = [in_frame(body.points, rotation_deg) for body in (outer, window)]
    low, high = points[0].min(axis=0), points[0].max(axis=0)
    place = [*(low[:2] + high[:2]) / 2, low[2]]
    turned = zip(points, (outer, window), strict=True)
    solid, support = (pv.PolyData.from_regular_faces(at - place, body.faces[:, ::-1]) for at, body in turned)
    return solid, support


def _looks_down(solid: Any, support: Any) -> bool:
    """Whether on the axis there is gel below the window, and none above it."""
    top = float(solid.points[:, 2].max())
    near = CONTACT * float(np.ptp(solid.points, axis=0).max())
    axis = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 2 * LONGEST_MM]])
    gel, window = (body.ray_trace(*axis)[0][:, 2] for body in (solid, support))
    if not len(gel) or not len(window):
        return False
    return bool(gel.min() + near < window.min() < top + near and gel.max() < window.max() + near)


def _solid(key: str, path: Path, unit: str) -> Triangles:
    """A closed surface, mm, in the file's own axes."""
    try:
        read = read_surface(path)
    except ValueError as error:
        raise ValueError(f"{key} = {path.name!r}: {error}") from None
    if not read.closed:
        raise ValueError(f"{key} = {path.name!r} has open edges; it must be a closed surface")
    if read.shells > 1:
        raise ValueError(f"{key} = {path.name!r} consists of {read.shells} pieces; it must be one")
    points = UNITS_MM[unit] * read.points
    longest = float(np.ptp(points, axis=0).max())
    if not SHORTEST_MM <= longest <= LONGEST_MM:
        raise ValueError(
            f'{key} = {path.name!r} is {longest:.3g} mm long with unit = "{unit}"; other units are '
            f"{', '.join(other for other in UNITS_MM if other != unit)}"
        )
    return replace(read, points=points)
