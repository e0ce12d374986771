"""Gels from files, as a shape: which nodes lie on it, where between them it runs, and where it is pressed."""

from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points, Projection, Triangles
from synth.errors import InputError
from synth.scene import Motion
from synth.scene.gel_file import UNITS_MM, GelSurfaces, distance, gel_surfaces, in_frame, nearest
from synth.scene.part import Vector3

ON_MM = 1e-6
"""Distance at which a node lies on a surface."""


@dataclass(frozen=True)
class CadFace:
    """The shape of a gel between two files' surfaces; the attributes are those of `synth.scene.FileGel`."""

    outer: Path
    window: Path
    unit: str
    rotation_deg: Vector3
    holds_end: bool
    volume_mm3 = None
    """Not known before the gel is meshed."""

    @cached_property
    def surfaces(self) -> GelSurfaces:
        return gel_surfaces(self.outer, self.window, self.unit, self.rotation_deg)

    def holds(self, points: Points) -> BoolArray:
        return np.asarray(distance(self.surfaces.face, points) <= ON_MM)

    def bonded(self, points: Points, size_mm: tuple[float, float, float]) -> BoolArray:
        """Which points (n, 3) mm lie on the window, or on an end that is held."""
        inner = np.asarray(distance(self.surfaces.window, points) <= ON_MM)
        return inner | (points[:, 2] >= self.surfaces.top_mm - ON_MM) if self.holds_end else inner

    def project(self, points: Points) -> Points:
        return nearest(self.surfaces.face, points)

    @property
    def sides(self) -> list[Projection]:
        found = self.surfaces
        parts = [partial(nearest, part) for part in (found.rest, found.window, found.face)]
        return [lambda points: np.column_stack([points[:, :2], np.full(len(points), found.top_mm)]), *parts]

    def textured(self) -> tuple[Points, Triangles, FloatArray]:
        """Corners (n, 3) mm and triangles (m, 3) of outer, and texture coordinates (n, 2); seams are apart.

        InputError where the file has no such coordinates.
        """
        import pyvista as pv

        read = pv.read(self.outer).extract_surface(algorithm=None).triangulate()
        places, faces = read.active_texture_coordinates, read.regular_faces
        if places is None:
            raise InputError(
                f'sensor.pattern.placing = "uv": {self.outer.name} has no texture coordinates; save it as OBJ or PLY'
            )
        points = in_frame(UNITS_MM[self.unit] * np.asarray(read.points, float), self.rotation_deg)
        points += self.surfaces.outer.points.min(axis=0) - points[faces].min(axis=(0, 1))
        return points, faces.astype(np.int32), np.asarray(places, float)

    def triangles(self, edge_mm: float) -> tuple[Points, Triangles]:
        """Triangles whose winding number is 1 in the gel and less elsewhere: outer's, and the window's turned over."""
        outer, window = self.surfaces.outer, self.surfaces.window
        faces = [outer.regular_faces, len(outer.points) + window.regular_faces[:, ::-1]]
        return np.concatenate([outer.points, window.points]), np.concatenate(faces).astype(np.int32)

    def frame(self, motion: Motion) -> tuple[FloatArray, FloatArray, float]:
        """The frame of a press: origin (3,) mm; axes (3, 3) as columns, the third inward; where on that the gel begins.

        The last is at most 0. The place lies below position_mm; or, where polar_deg or height_mm is given, on a ray
        from the axis, which starts half the gel's width above its lowest point or is level. InputError where there is
        no coated face.
        """
        face, size = self.surfaces.face, np.array(self.surfaces.size_mm)
        level, axes = motion.height_mm is not None, np.eye(3)
        if along_z := motion.polar_deg is None and not level:
            start, ray = np.array([*motion.position_mm, size[2] + 1]), np.array([0.0, 0.0, -1.0])
        else:
            azimuth, polar = np.radians([motion.azimuth_deg, 90.0 if level else motion.polar_deg or 0.0])
            start = np.array([0.0, 0.0, motion.height_mm if level else size[:2].min() / 2])
            ray = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), -np.cos(polar)])
        hits, cells = face.ray_trace(start, start + 2 * size.sum() * ray)
        if len(hits) == 0:
            given = motion.model_dump(include={"position_mm", "polar_deg", "height_mm", "azimuth_deg"})
            raise InputError(f"motion: the gel has no coated face at {given}")
        last = int(np.argmax((hits - start) @ ray))
        origin = np.asarray(hits[last], float) * ((0.0, 0.0, 1.0) if along_z else 1.0)
        if not along_z:
            inward = -np.asarray(face.face_normals[cells[last]], float)
            first = np.cross([-np.sin(azimuth), np.cos(azimuth), 0.0], inward)
            first /= np.linalg.norm(first)
            axes = np.column_stack([first, np.cross(inward, first), inward])
        return origin, axes, min(0.0, float(((face.points - origin) @ axes[:, 2]).min()))

    def check(self, motion: Motion, edge_mm: float) -> None:
        """Refuse a press beside the face, and a gel that is thinner than an element; InputError says where."""
        self.frame(motion)
        thinnest, place = self.surfaces.thinnest()
        if thinnest < edge_mm:
            raise InputError(
                f"sensor.gel: at {np.round(place, 2).tolist()} mm it is {thinnest:.3g} mm thick, thinner than an "
                f"element's edge of {edge_mm:.3g} mm; give a smaller numerics.edge_length_mm, or another window"
            )

    def __str__(self) -> str:
        return f"gel between {self.outer.name} and {self.window.name}"
