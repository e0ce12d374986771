"""A view traced in single precision by Warp's `Mesh`: what a renderer's own ray tracing would give in place of ours.

Rays and vertices are rounded to float32, and so are the hits; the points that they name are interpolated and projected
in float64. `synth.flow.trace` is the same in float64 throughout.
"""

import numpy as np
import warp as wp

from synth.arrays import BoolArray, FloatArray, Points, Triangles
from synth.flow.hits import Hits
from synth.flow.view import View
from synth.optics import Rays

wp.set_module_options({"enable_backward": False})

TOLERANCE_MM = 1e-3
"""A hit nearer than the point itself by more than this hides it. Single precision is 2e-6 mm at 30 mm; a slanted
surface magnifies that."""


class SingleView(View):
    """A view whose rays are traced in single precision."""

    def first_hits(self, positions: Points) -> Hits:
        """What the pixel centres see of a state (v, 3) mm."""
        return trace_single(positions, self.triangles, self.own.origins, self.own.directions)

    def _is_unobstructed(self, points: Points, rays: Rays, positions: Points) -> BoolArray:
        distance: FloatArray = np.linalg.norm(points - rays.origins, axis=1)
        first = trace_single(positions, self.triangles, rays.origins, rays.directions).distance
        return np.asarray(first >= distance - TOLERANCE_MM)


def trace_single(positions: Points, triangles: Triangles, origins: Points, directions: Points) -> Hits:
    """Where rays first meet a surface, by float32 arithmetic.

    Args:
        positions: (v, 3) float64 mm.
        triangles: (f, 3) int32 into `positions`.
        origins: (n, 3) float64 mm; NaN for rays that do not exist.
        directions: (n, 3) float64, unit.
    """
    points, starts, ways = (
        wp.array(np.asarray(array, dtype=np.float32), dtype=wp.vec3, device="cpu")
        for array in (positions, origins, directions)
    )
    mesh = wp.Mesh(points, wp.array(np.asarray(triangles, dtype=np.int32).ravel(), dtype=wp.int32, device="cpu"))
    rays = len(origins)
    outputs = [
        wp.empty(rays, dtype=wp.int32, device="cpu"),
        wp.empty(rays, dtype=wp.vec3, device="cpu"),
        wp.empty(rays, dtype=wp.float32, device="cpu"),
    ]
    wp.launch(_nearest, dim=rays, inputs=[mesh.id, starts, ways], outputs=outputs, device="cpu")
    triangle, weights, distance = (array.numpy() for array in outputs)
    return Hits(triangle, weights.astype(np.float64), distance.astype(np.float64))


@wp.kernel
def _nearest(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    triangle: wp.array[wp.int32],
    weights: wp.array[wp.vec3],
    distance: wp.array[wp.float32],
) -> None:
    ray = wp.tid()
    triangle[ray] = -1
    weights[ray] = wp.vec3(wp.nan)
    distance[ray] = wp.inf
    if not wp.isnan(directions[ray][0]):
        hit = wp.mesh_query_ray(mesh, origins[ray], directions[ray], wp.inf)
        if hit.result:
            triangle[ray] = hit.face
            distance[ray] = hit.t
            weights[ray] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
