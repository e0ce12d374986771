"""What rays meet of the gel, or of its mirror image behind the window, for vectorised variants.

An image's point stands for the gel's own, and the ray for its mirror image. All points are computed on the one mesh of
the gel: a virtual function over Mitsuba's shapes would be other code, to be compiled anew, with each other scene that
happens to be alive.
"""

from typing import Any


class GelHits:
    """On the shapes of one scene: "gel", and "image" where the window reflects."""

    def __init__(self, shapes: dict[str, Any], mi: Any) -> None:
        import drjit as dr

        self._mi, self._dr, self._gel = mi, dr, shapes["gel"]
        self._pointers = [mi.ShapePtr(shapes[name]) for name in ("gel", "image") if name in shapes]
        dr.make_opaque(self._pointers)

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
        at.initialize_sh_frame()
        at.wi = at.to_local(-ray.d)
        return at
