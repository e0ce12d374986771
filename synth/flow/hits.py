"""Where rays meet a triangle surface, and values at the vertices interpolated there, by a Warp kernel on the CPU."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from synth.arrays import FloatArray, Triangles

wp.config.log_level = wp.LOG_WARNING
wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class Hits:
    """Nearest hits, one for each ray.

    Attributes:
        triangle: (n,) int32, -1 where the ray hits nothing.
        barycentric: (n, 3) float64 weights of the triangle's vertices; NaN where nothing is hit.
        distance: (n,) float64 mm along the unit direction; infinite where nothing is hit.
    """

    triangle: NDArray[np.int32]
    barycentric: FloatArray
    distance: FloatArray

    def interpolate(self, triangles: Triangles, values: FloatArray) -> FloatArray:
        """Values (n, c) at the hits from values (v, c) at the vertices; NaN where nothing is hit."""
        rays = len(self.triangle)
        found = wp.empty((rays, values.shape[1]), dtype=wp.float64, device="cpu")
        given = (
            (self.triangle, np.int32, wp.int32),
            (self.barycentric, np.float64, wp.vec3d),
            (triangles, np.int32, wp.int32),
            (values, np.float64, wp.float64),
        )
        inputs = [as_warp(array, kind, element) for array, kind, element in given]
        wp.launch(_interpolate, dim=rays, inputs=inputs, outputs=[found], device="cpu")
        return np.asarray(found.numpy())


def as_warp(array: Any, kind: type, element: Any) -> Any:
    """A Warp array in the caller's own memory, which kernels only read."""
    return wp.array(np.ascontiguousarray(array, dtype=kind), dtype=element, device="cpu", copy=False)


@wp.kernel
def _interpolate(
    triangle: wp.array[wp.int32],
    barycentric: wp.array[wp.vec3d],
    corners: wp.array2d[wp.int32],
    values: wp.array2d[wp.float64],
    found: wp.array2d[wp.float64],
) -> None:
    ray = wp.tid()
    t, weights = triangle[ray], barycentric[ray]
    for k in range(values.shape[1]):
        if t < 0:
            found[ray, k] = wp.float64(wp.nan)
        else:
            a, b, c = values[corners[t, 0], k], values[corners[t, 1], k], values[corners[t, 2], k]
            found[ray, k] = weights[0] * a + weights[1] * b + weights[2] * c
