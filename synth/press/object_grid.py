r"""The signed distance of an object, its edges rounded, sampled on a grid for B-splines.

A gel is pressed by what its mesh can follow: sharper edges and notches are rounded, as `synth.press.indenter` rounds
the edges of analytic shapes. With d the signed distance (negative inside) and S = {d <= 0}, rounding to a radius r is
an opening, the union of all balls of radius r within S, and then a closing, the same for what is outside:

.. math::  d_1(x) = \min_k (dist(x, E_k) - r_k), \quad E_0 = \{d \le -r\}, \qquad d_2(x) = r - dist(x, \{d_1 \ge r\})

A part thinner than 2 r holds no such ball and would be lost, so that what lies farther than LOST r from the opening is
opened again with half the radius (E_k), and so on down to the grid's spacing. Distances are to triangles: the file's,
and those of contours that keep their edges (`synth.press.object_contour`). The sign of d is that of the generalised
winding number (Jacobson, Kavan & Sorkine-Hornung 2013), which closes holes and fills cavities.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from synth.arrays import BoolArray, FloatArray, Points
from synth.press.object_contour import crossings, sharp_contour
from synth.scene.surface_file import Triangles

STRIDE = 3
"""Far from the surface every STRIDE-th sample along an axis is exact, the others are interpolated."""
LOST = 1.25
"""What an opening by r leaves out farther than this times r is a thin part or a sharp tip. A right-angled edge loses
0.41 r, its corner 0.73 r, a tetrahedron's edge 0.73 r and its corner 2 r."""
BEYOND = 0.05
"""Spacings beyond a face where a place within the solid shows that the face is inside, not on its boundary."""
TOUCHING_MM = wp.constant(1e-4)
"""Points that are nearer to a surface have its normal for the gradient of their distance."""
Core = tuple["Nearest", float]


@dataclass(frozen=True, eq=False)
class Grid:
    """Places of samples, corner + spacing (i, j, k), with corner (3,) and spacing in mm."""

    corner: FloatArray
    spacing: float
    counts: tuple[int, int, int]

    def points(self, where: BoolArray) -> Points:
        return self.corner + self.spacing * np.argwhere(where)

    def at(self, points: Points, values: FloatArray) -> FloatArray:
        """Samples' values between them, linearly, at points (n, 3); beyond the grid those of its edge."""
        from scipy.ndimage import map_coordinates

        return np.asarray(map_coordinates(values, ((points - self.corner) / self.spacing).T, order=1, mode="nearest"))

    def distance(self, surface: "Nearest", where: BoolArray) -> FloatArray:
        """Distances of some samples from a surface, mm; infinite elsewhere."""
        found = np.full(self.counts, np.inf)
        found[where] = surface.away(self.points(where))
        return found

    def _coarse(self, function: Callable[[Points], FloatArray]) -> FloatArray:
        """A function of points (n, 3) at every STRIDE-th sample along each axis, linearly interpolated between them."""
        from scipy.interpolate import make_interp_spline

        known = [np.unique([*range(0, count, STRIDE), count - 1]) for count in self.counts]
        places = np.stack(np.meshgrid(*known, indexing="ij"), axis=-1)
        values = function(self.corner + self.spacing * places.reshape(-1, 3)).reshape(places.shape[:3])
        for axis, count in enumerate(self.counts):
            values = make_interp_spline(known[axis], values, k=1, axis=axis)(np.arange(count))
        return values

    def _away(self, surface: "Nearest", reach_mm: float) -> FloatArray:
        """Distances of all samples from a surface, mm; beyond the reach, where queries take longer, interpolated."""
        away = self._coarse(surface.away)
        near = away < reach_mm + np.sqrt(3) * STRIDE / 2 * self.spacing
        return np.where(near, self.distance(surface, near), away)

    def signed_distance(self, surface: Triangles, radius_mm: float) -> FloatArray:
        """Distances of all samples, negative inside, and exact where edges are rounded to that radius.

        Winding numbers take longer and are found near the surface only. A closed one lies between neighbouring
        samples of different sign: the signs of others are those next to them toward +z. Around an open one they are
        those of coarse samples, the nearest of which is √3 spacings away, and found, too, where these differ.
        """
        nearest, closed = Nearest(surface, winding=True), surface.closed
        away = self._away(nearest, radius_mm + 3 * self.spacing)
        sign = np.ones(self.counts) if closed else self._coarse(nearest.signs)
        known = (away < (1.1 if closed else 1.75) * self.spacing) | (np.abs(sign) < 0.99)
        sign[known] = nearest.signs(self.points(known))
        if closed:
            above = np.where(known, np.arange(self.counts[2]), self.counts[2] - 1)
            sign = np.take_along_axis(sign, np.minimum.accumulate(above[:, :, ::-1], axis=2)[:, :, ::-1], axis=2)
        return away * sign

    def boundary(self, values: FloatArray, surface: Triangles, radius_mm: float) -> tuple[FloatArray, Triangles]:
        """Signed distances from the boundary alone, and the boundary: a contour if any face lies inside."""
        nearest, within = Nearest(surface, winding=True), (values < 0) & (values > -1.1 * self.spacing)
        if (nearest.signs(self.points(within), BEYOND * self.spacing) > 0).all():
            return values, surface
        outer = sharp_contour(values, self.corner, self.spacing, nearest.depth)
        away = self._away(Nearest(outer), radius_mm + 3 * self.spacing)
        return np.where(values < 0, -1.0, 1.0) * away, outer

    def missing(self, values: FloatArray) -> float:
        """The share of the boundary of what is inside that is far from the surface: where holes were closed.

        Across a surface two neighbouring samples of the signed distance are at most a spacing apart.
        """
        here, there, _ = crossings(values < 0)
        jump = np.abs(values[tuple(here.T)] - values[tuple(there.T)])
        return float(np.mean(jump > 2 * self.spacing)) if len(jump) else 0.0

    def rounded(self, values: FloatArray, surface: Triangles, radius_mm: float) -> FloatArray:
        """The signed distance of a solid after its edges and notches are rounded; see the module's docstring."""
        cores, opened = self._opened(values, Nearest(surface), radius_mm)

        def outer(points: Points) -> tuple[FloatArray, Points]:
            """Distance from the opening less the radius, and its gradient."""
            offsets = [(points - core(points)[0], radius) for core, radius in cores]
            lengths = np.array([np.linalg.norm(offset, axis=1) - radius for offset, radius in offsets])
            first = lengths.argmin(axis=0)
            nearest = np.array([offset for offset, _ in offsets])[first, np.arange(len(points))]
            return lengths.min(axis=0) - radius_mm, nearest / np.linalg.norm(nearest, axis=1, keepdims=True)

        shell = sharp_contour(opened - radius_mm, self.corner, self.spacing, outer)
        if not cores or len(shell.faces) == 0:
            return values
        band = np.abs(values) < radius_mm + 2 * self.spacing  # the surface moves by less than the radius
        away = self.distance(Nearest(shell), band)
        closed = radius_mm + np.where(opened > radius_mm, away, -away)
        return np.where(band, closed, values)

    def _opened(self, values: FloatArray, surface: "Nearest", radius_mm: float) -> tuple[list[Core], FloatArray]:
        """The E_k with their r_k, and samples of d_1 where its sign, or that of d_1 - r, is not d's; d elsewhere."""
        from scipy.ndimage import distance_transform_edt

        cores: list[Core] = []
        band = np.abs(values) < radius_mm + 2 * self.spacing
        found, near = np.where(band, np.inf, values), np.ones(self.counts, dtype=bool)
        while True:

            def inner(points: Points, radius: float = radius_mm) -> tuple[FloatArray, Points]:
                """The signed distance of points inside plus the radius, and its gradient."""
                depth, gradient = surface.depth(points)
                return radius + depth, gradient

            core = np.where(near, values + radius_mm, np.maximum(values + radius_mm, self.spacing))
            contour = sharp_contour(core, self.corner, self.spacing, inner)
            if len(contour.faces):
                cores.append((Nearest(contour), radius_mm))
                away = self.distance(cores[-1][0], band)
                found = np.where(band, np.minimum(found, np.where(core <= 0, -away, away) - radius_mm), found)
            lost = (values <= 0) & (found > LOST * radius_mm)
            if radius_mm == 0 or not lost.any():
                return cores, found
            near = distance_transform_edt(~lost, sampling=self.spacing) <= (1 + LOST) * radius_mm
            radius_mm = radius_mm / 2 if radius_mm > 2 * self.spacing else 0.0


class Nearest:
    """Nearest points of a triangle surface, by Warp's bounding volume hierarchy in single precision."""

    def __init__(self, surface: Triangles, winding: bool = False) -> None:
        """winding: whether `signs` will be asked for."""
        points = wp.array(surface.points.astype(np.float32), dtype=wp.vec3, device="cpu")
        corners = wp.array(surface.faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu")
        self._mesh = wp.Mesh(points, corners, support_winding_number=winding)

    def __call__(self, points: Points) -> tuple[Points, Points]:
        """The nearest points of the surface to others (n, 3), and its normals there."""
        found, normal = (wp.empty(len(points), dtype=wp.vec3, device="cpu") for _ in range(2))
        inputs = [self._mesh.id, wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")]
        wp.launch(_nearest, len(points), inputs=inputs, outputs=[found, normal], device="cpu")
        return found.numpy().astype(np.float64), normal.numpy().astype(np.float64)

    def away(self, points: Points) -> FloatArray:
        """The distances of points (n, 3)."""
        return np.asarray(np.linalg.norm(points - self(points)[0], axis=1))

    def depth(self, points: Points) -> tuple[FloatArray, Points]:
        """The signed distance of points (n, 3) that are inside, and its gradient."""
        nearest, normal = self(points)
        away = np.linalg.norm(nearest - points, axis=1)
        toward = (nearest - points) / np.maximum(away, TOUCHING_MM)[:, None]
        return -away, np.where(away[:, None] < TOUCHING_MM, normal, toward)

    def signs(self, points: Points, beyond_mm: float = 0.0) -> FloatArray:
        """-1 for points (n, 3) inside, with a winding number above 1/2, else 1; or for places beyond the nearest faces.

        Those are 1, too, where another face is nearer.
        """
        found = wp.empty(len(points), dtype=wp.float32, device="cpu")
        inputs = [self._mesh.id, wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu"), beyond_mm]
        wp.launch(_signs, len(points), inputs=inputs, outputs=[found], device="cpu")
        return found.numpy().astype(np.float64)


@wp.kernel
def _nearest(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), found: wp.array(dtype=wp.vec3), normal: wp.array(dtype=wp.vec3)
):
    i = wp.tid()
    near = wp.mesh_query_point_no_sign(mesh, points[i], wp.inf)
    found[i] = wp.mesh_eval_position(mesh, near.face, near.u, near.v)
    normal[i] = wp.mesh_eval_face_normal(mesh, near.face)


@wp.kernel
def _signs(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), beyond: float, found: wp.array(dtype=wp.float32)):
    i = wp.tid()
    place = points[i]
    if beyond > 0.0:
        near = wp.mesh_query_point_no_sign(mesh, place, wp.inf)
        nearest = wp.mesh_eval_position(mesh, near.face, near.u, near.v)
        along = wp.mesh_eval_face_normal(mesh, near.face)
        if wp.length(nearest - place) > TOUCHING_MM:
            along = wp.normalize(nearest - place)
        place = nearest + beyond * along
    found[i] = 1.0
    if beyond == 0.0 or not wp.mesh_query_point_no_sign(mesh, place, 0.9 * beyond).result:
        found[i] = wp.mesh_query_point_sign_winding_number(mesh, place, wp.inf, 2.0, 0.5).sign
