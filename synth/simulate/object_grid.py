r"""The signed distance of an object, its edges rounded, sampled on a grid for B-splines.

A gel is pressed by what its mesh can follow: sharper edges and notches are rounded, as `synth.simulate.indenter` rounds
the edges of analytic shapes. With d the signed distance (negative inside) and S = {d <= 0}, rounding to a radius r is
an opening, the union of all balls of radius r within S, and then a closing, the same for what is outside:

.. math::  d_1(x) = \min_k (dist(x, E_k) - r_k), \quad E_0 = \{d \le -r\}, \qquad d_2(x) = r - dist(x, \{d_1 \ge r\})

A part thinner than 2 r holds no such ball and would be lost, so that what lies farther than LOST r from the opening is
opened again with half the radius (E_k), and so on down to the grid's spacing. Each distance is to the triangles of a
contour on the grid, without regard to sign; the sign of the first is that of the generalised winding number (Jacobson,
Kavan & Sorkine 2013), which closes holes and fills cavities.
"""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

from dataclasses import dataclass

import numpy as np
import warp as wp

from synth.arrays import BoolArray, FloatArray
from synth.simulate.object_surface import Triangles

wp.set_module_options({"enable_backward": False, "fast_math": False})

LOST = 1.25
"""What an opening by r leaves out farther than this times r is a thin part or a sharp tip. A right-angled edge loses
0.41 r, its corner 0.73 r, a tetrahedron's edge 0.73 r and its corner 2 r."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Samples of a function at corner + spacing (i, j, k).

    Attributes:
        corner: (3,) mm.
        spacing: mm.
        values: (i, j, k).
    """

    corner: FloatArray
    spacing: float
    values: FloatArray

    def contour(self, level: float) -> Triangles:
        """The surface on which the function has a value; without triangles where it has not."""
        import pyvista as pv

        image = pv.ImageData(dimensions=self.values.shape, spacing=(self.spacing,) * 3, origin=self.corner)
        image.point_data["value"] = self.values.ravel(order="F")
        surface = image.contour([level], scalars="value", method="flying_edges", compute_normals=False)
        faces = surface.faces.reshape(-1, 4)[:, 1:] if surface.n_cells else np.zeros((0, 3), dtype=np.int64)
        return Triangles(np.asarray(surface.points, dtype=np.float64), faces, True)

    def distance(self, surface: Triangles, signed: bool = False) -> FloatArray:
        """Distances of the samples from a surface, mm; negative inside where signed. Infinite without triangles."""
        if len(surface.faces) == 0:
            return np.full(self.values.shape, np.inf)
        points = wp.array(surface.points.astype(np.float32), dtype=wp.vec3, device="cpu")
        corners = wp.array(surface.faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
        mesh = wp.Mesh(points, corners, support_winding_number=signed)
        found = wp.empty(self.values.shape, dtype=wp.float32, device="cpu")
        inputs = [mesh.id, wp.vec3(*self.corner), self.spacing, int(signed)]
        wp.launch(_distance, self.values.shape, inputs=inputs, outputs=[found], device="cpu")
        return found.numpy().astype(np.float64)

    def holding(self, values: FloatArray) -> "Grid":
        """Other values at the same places."""
        return Grid(self.corner, self.spacing, values)


@wp.kernel
def _distance(mesh: wp.uint64, corner: wp.vec3, spacing: float, winding: int, found: wp.array3d(dtype=wp.float32)):
    i, j, k = wp.tid()
    p = corner + spacing * wp.vec3(float(i), float(j), float(k))
    if winding == 1:
        near = wp.mesh_query_point_sign_winding_number(mesh, p, 1.0e6)
        found[i, j, k] = near.sign * wp.length(p - wp.mesh_eval_position(mesh, near.face, near.u, near.v))
    else:
        near = wp.mesh_query_point_no_sign(mesh, p, 1.0e6)
        found[i, j, k] = wp.length(p - wp.mesh_eval_position(mesh, near.face, near.u, near.v))


def rounded(solid: Grid, radius_mm: float) -> Grid:
    """A solid's signed distance after its edges and notches are rounded to a radius; see the module's docstring."""
    opened = solid.holding(_opened(solid, radius_mm))
    outer = opened.contour(radius_mm)
    away = opened.distance(outer)
    return solid.holding(radius_mm + np.where(opened.values > radius_mm, away, -away))


def _opened(solid: Grid, radius_mm: float) -> FloatArray:
    """Signed distance from the opening, exact outside and down to the radius."""
    inside = solid.values <= 0
    found = np.full(solid.values.shape, np.inf)
    near: BoolArray | None = None
    while True:
        core = solid.values + radius_mm
        if near is not None:
            core = np.maximum(core, solid.spacing * np.where(near, -1.0, 1.0))
        eroded = solid.holding(core)
        away = eroded.distance(eroded.contour(0.0))
        found = np.minimum(found, np.where(core <= 0, -away, away) - radius_mm)
        lost = inside & (found > LOST * radius_mm)
        if radius_mm <= 0 or not lost.any():
            return found
        reach = (1 + LOST) * radius_mm
        near = _within(solid, lost, reach)
        radius_mm = radius_mm / 2 if radius_mm > 2 * solid.spacing else 0.0


def _within(grid: Grid, part: BoolArray, reach_mm: float) -> BoolArray:
    """The samples that are no farther than that from one of a part."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(~part, sampling=grid.spacing) <= reach_mm)
