"""What rays meet of the gel, or of its mirror image behind the window, for vectorised variants.

An image's point stands for the gel's own, and the ray for its mirror image. All points are computed on the one mesh of
the gel: a virtual function over Mitsuba's shapes would be other code, to be compiled anew, with each other scene that
happens to be alive.

Normals are the gel's own, too (`vertex_normals`): Mitsuba's sums are atomic, so their rounding depends on the order in
which threads come.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.render.aligned import aligned
from synth.render.gel_mesh import GelMesh


@dataclass(init=False, eq=False)
class GelHits:
    """On the shapes of one scene: "gel", and "image" where the window reflects. `place` says how the gel lies.

    Attributes:
        corners: the faces' vertices, 3 of mi.UInt32.
        positions: of the vertices, mi.Point3f mm in the renderer's frame.
        normals: of the vertices, mi.Vector3f, unit, out of the gel.
    """

    corners: list[Any]
    positions: Any
    normals: Any
    _mi: Any
    _dr: Any
    _gel: Any
    _pointers: list[Any]
    _incident: list[Any]

    def __init__(self, shapes: dict[str, Any], mesh: GelMesh, mi: Any) -> None:
        import drjit as dr

        self._mi, self._dr, self._gel = mi, dr, shapes["gel"]
        self._pointers = [mi.ShapePtr(shapes[name]) for name in ("gel", "image") if name in shapes]
        dr.make_opaque(self._pointers)
        self.take(mesh)
        self.place(mi.Float(mesh.positions(mesh.surface.material)))

    def take(self, mesh: GelMesh) -> None:
        """Faces of another surface."""
        mi = self._mi
        self.corners = [mi.UInt32(aligned(column, np.uint32)) for column in mesh.faces().reshape(-1, 3).T]
        self._incident = [mi.UInt32(aligned(column, np.uint32)) for column in mesh.incident.T]

    def place(self, positions: Any) -> None:
        """How the gel lies now, by its vertices (3 v of mi.Float)."""
        self.positions = self._dr.unravel(self._mi.Point3f, positions)
        self.normals = vertex_normals(self.positions, self.corners, self._incident, self._mi)

    def kinds(self, hit: Any, active: Any) -> tuple[Any, Any]:
        """Whether a hit (mi.PreliminaryIntersection3f) is on the gel itself, and whether on its image (mi.Bool)."""
        met = active & hit.is_valid()
        on = [met & (hit.shape == pointer) for pointer in self._pointers]
        return on[0], on[1] if len(on) > 1 else self._mi.Bool(False)

    def point(self, ray: Any, hit: Any, mirrored: Any, active: Any) -> Any:
        """The gel's point (mi.SurfaceInteraction3f), whose frame is the scene's, where the hit is on gel or image."""
        mi, dr = self._mi, self._dr
        ray, hit = mi.Ray3f(ray), mi.PreliminaryIntersection3f(hit)
        ray.d.z = dr.select(mirrored, -ray.d.z, ray.d.z)
        # An image's faces have their corners in reverse order.
        hit.prim_uv.y = dr.select(mirrored, 1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.y)
        at = self._gel.compute_surface_interaction(ray, hit, mi.RayFlags.All, active)
        weights = (1 - hit.prim_uv.x - hit.prim_uv.y, hit.prim_uv.x, hit.prim_uv.y)
        at.sh_frame.n = mi.Normal3f(self.normal(hit.prim_index, weights, active))
        at.initialize_sh_frame()
        at.wi = at.to_local(-ray.d)
        return at

    def normal(self, face: Any, weights: tuple[Any, Any, Any], active: Any = True) -> Any:
        """Unit normals (mi.Vector3f), out of the gel, at points of faces by their corners' weights."""
        mi, dr = self._mi, self._dr
        vertices = (dr.gather(mi.UInt32, corner, face, active) for corner in self.corners)
        parts = (dr.gather(mi.Vector3f, self.normals, vertex, active) for vertex in vertices)
        return dr.normalize(sum(part * weight for part, weight in zip(parts, weights, strict=True)))


def vertex_normals(positions: Any, corners: list[Any], incident: list[Any], mi: Any) -> Any:
    """Unit normals (mi.Vector3f) of vertices at mi.Point3f: the mean of their faces' normals, weighted by area.

    Sums have the order of `incident`, the k columns (mi.UInt32) of `GelMesh.incident`.
    """
    import drjit as dr

    a, b, c = (dr.gather(mi.Point3f, positions, corner) for corner in corners)
    faces = mi.Vector3f(dr.cross(b - a, c - a))
    dr.eval(faces)  # once, and not for each of their corners
    exists = [column < dr.opaque(mi.UInt32, dr.width(corners[0])) for column in incident]
    found = dr.normalize(sum(dr.gather(mi.Vector3f, faces, i, on) for i, on in zip(incident, exists, strict=True)))
    dr.eval(found)
    return found
