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

BAND = 2.0
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

    def distance(self, surface: Triangles, where: BoolArray) -> FloatArray:
        """Distances of some samples from a surface, mm; infinite elsewhere, and without triangles."""
        found = np.full(self.values.shape, np.inf)
        if len(surface.faces) > 0:
            found[where] = self._measured(surface, 0.0, where)[0]
        return found

    def signed_distance(self, surface: Triangles) -> FloatArray:
        """Distances of all samples, negative inside.

        A closed surface lies between two neighbouring samples of different sign: winding numbers, which take ten times
        as long as distances, are then found near it alone, and the signs of others are those next to them toward +z.
        """
        near = 2 * self.spacing if surface.closed else np.inf
        shape = self.values.shape
        away, sign = (values.reshape(shape) for values in self._measured(surface, near, np.ones(shape, dtype=bool)))
        above = np.where(sign == 0, shape[2], np.arange(shape[2]))
        above = np.minimum.accumulate(above[:, :, ::-1], axis=2)[:, :, ::-1]
        outside = np.ones((*shape[:2], 1))
        return np.asarray(away * np.take_along_axis(np.concatenate([sign, outside], axis=2), above, axis=2))

    def _measured(self, surface: Triangles, near_mm: float, where: BoolArray) -> tuple[FloatArray, FloatArray]:
        """(n,) distances of some samples, and their signs where they are less than `near_mm`, else 0."""
        points = wp.array(surface.points.astype(np.float32), dtype=wp.vec3, device="cpu")
        corners = wp.array(surface.faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
        mesh = wp.Mesh(points, corners, support_winding_number=near_mm > 0)
        places = self.corner + self.spacing * np.argwhere(where)
        samples = wp.array(places.astype(np.float32), dtype=wp.vec3, device="cpu")
        away, sign = (wp.empty(len(places), dtype=wp.float32, device="cpu") for _ in range(2))
        wp.launch(_distance, len(places), inputs=[mesh.id, samples, near_mm], outputs=[away, sign], device="cpu")
        return away.numpy().astype(np.float64), sign.numpy().astype(np.float64)

    def holding(self, values: FloatArray) -> "Grid":
        """Other values at the same places."""
        return Grid(self.corner, self.spacing, values)


@wp.kernel
def _distance(
    mesh: wp.uint64,
    samples: wp.array(dtype=wp.vec3),
    near: float,
    away: wp.array(dtype=wp.float32),
    sign: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    p = samples[i]
    found = wp.mesh_query_point_no_sign(mesh, p, 1.0e6)
    away[i] = wp.length(p - wp.mesh_eval_position(mesh, found.face, found.u, found.v))
    sign[i] = 0.0
    if away[i] < near:
        sign[i] = wp.mesh_query_point_sign_winding_number(mesh, p, 1.0e6).sign


def rounded(solid: Grid, radius_mm: float) -> Grid:
    """A solid's signed distance after its edges and notches are rounded to a radius; see the module's docstring.

    Beyond BAND radii from the surface, where no gel that touches is, it is the solid's as it was.
    """
    band = np.abs(solid.values) < BAND * radius_mm + 2 * solid.spacing
    opened = solid.holding(_opened(solid, radius_mm, band))
    away = opened.distance(opened.contour(radius_mm), band)
    closed = radius_mm + np.where(opened.values > radius_mm, away, -away)
    return solid.holding(np.where(np.isfinite(closed), closed, solid.values))


def _opened(solid: Grid, radius_mm: float, band: BoolArray) -> FloatArray:
    """Signed distance from the opening, exact outside and down to the radius within the band."""
    inside = solid.values <= 0
    found = np.where(band, np.inf, solid.values)
    near = band
    while True:
        core = np.where(near, solid.values + radius_mm, np.maximum(solid.values + radius_mm, solid.spacing))
        if near is band:
            core = solid.values + radius_mm
        eroded = solid.holding(core)
        away = eroded.distance(eroded.contour(0.0), band)
        found = np.minimum(found, np.where(core <= 0, -away, away) - radius_mm)
        lost = inside & band & (found > LOST * radius_mm)
        if radius_mm <= 0 or not lost.any():
            return found
        near = band & _within(solid, lost, (1 + LOST) * radius_mm)
        radius_mm = radius_mm / 2 if radius_mm > 2 * solid.spacing else 0.0


def _within(grid: Grid, part: BoolArray, reach_mm: float) -> BoolArray:
    """The samples that are no farther than that from one of a part."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(distance_transform_edt(~part, sampling=grid.spacing) <= reach_mm)
