"""Gels from CAD files: two closed surfaces, read, checked and brought into the sensor's frame.

The gel is what lies inside `outer` and outside `window`. Both are moved so that outer's bounding box is centred in x
and y and begins at z = 0; y changes its sign, because files have right-handed axes and the frame is left-handed.
"""

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import FloatArray, Points
from synth.scene.surface_file import read_surface

UNITS_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
SHORTEST_MM, LONGEST_MM = 2.0, 400.0
"""Longest edges of bounding boxes beyond which a file is taken to be in another unit."""
CONTACT = 2e-3
"""Outer and window touch where they are nearer than this share of outer's longest edge."""
SHARP_DEG = 40.0
"""The coated face ends at edges that are sharper."""
SAMPLES = 300
"""Triangles at which a gel's thickness is measured."""


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


def gel_surfaces(outer: Path, window: Path, unit: str) -> GelSurfaces:
    """Read both files; ValueError says in a sentence what is wrong with one of them."""
    return _checked(outer, window, unit, *(path.stat().st_mtime_ns for path in (outer, window) if path.is_file()))


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
            surfaces = gel_surfaces(*files, unit)
            digest = hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files))
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
def _checked(outer: Path, window: Path, unit: str, *changed_ns: int) -> GelSurfaces:
    import pyvista as pv

    solid, support = _solid("outer", outer, unit), _solid("window", window, unit)
    low, high = solid.points.min(axis=0), solid.points.max(axis=0)
    for body in (solid, support):
        body.points -= [*(low[:2] + high[:2]) / 2, low[2]]
    near = CONTACT * float((high - low).max())
    points, faces = solid.points, solid.regular_faces
    hits, cells = solid.ray_trace([0.0, 0.0, -1.0], [0.0, 0.0, high[2] - low[2] + 1])
    if len(hits) == 0:
        raise ValueError(f"outer = {outer.name!r} has no face on its axis")
    parted = solid.compute_normals(split_vertices=True, feature_angle=SHARP_DEG, consistent_normals=False)
    region = parted.connectivity("all").cell_data["RegionId"]
    coated = region == region[cells[hits[:, 2].argmin()]]
    apart = (points[:, 2] < points[:, 2].max() - 1e-6) & (distance(support, points) > near)
    parts = coated, ~coated & apart[faces].any(axis=1)
    found = GelSurfaces(solid, support, *(pv.PolyData.from_regular_faces(points, faces[part]) for part in parts))
    thickness = found.thickness_mm
    if not thickness <= hits[:, 2].max() + near:
        raise ValueError(
            f"window = {window.name!r} lies outside of outer = {outer.name!r}: it holds no gel on the axis"
        )
    if thickness <= near:
        raise ValueError(f"window = {window.name!r} reaches through the gel at the middle of its face")
    return found


def _solid(key: str, path: Path, unit: str) -> Any:
    import pyvista as pv

    try:
        read = read_surface(path)
    except ValueError as error:
        raise ValueError(f"{key} = {path.name!r}: {error}") from None
    if not read.closed:
        raise ValueError(f"{key} = {path.name!r} has open edges; it must be a closed surface")
    if read.shells > 1:
        raise ValueError(f"{key} = {path.name!r} consists of {read.shells} pieces; it must be one")
    points = UNITS_MM[unit] * read.points * [1, -1, 1]
    longest = float(np.ptp(points, axis=0).max())
    if not SHORTEST_MM <= longest <= LONGEST_MM:
        raise ValueError(
            f'{key} = {path.name!r} is {longest:.3g} mm long with unit = "{unit}"; other units are '
            f"{', '.join(other for other in UNITS_MM if other != unit)}"
        )
    return pv.PolyData.from_regular_faces(points, read.faces[:, ::-1])
