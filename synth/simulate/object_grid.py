r"""The signed distance of an object, its edges rounded, sampled on a grid for B-splines.

A gel is pressed by what its mesh can follow: sharper edges and notches are rounded, as `synth.simulate.indenter` rounds
the edges of analytic shapes. With d the signed distance (negative inside) and S = {d <= 0}, rounding to a radius r is
an opening, the union of all balls of radius r within S, and then a closing, the same for what is outside:

.. math::  d_1(x) = \min_k (dist(x, E_k) - r_k), \quad E_0 = \{d \le -r\}, \qquad d_2(x) = r - dist(x, \{d_1 \ge r\})

A part thinner than 2 r holds no such ball and would be lost, so that what lies farther than LOST r from the opening is
opened again with half the radius (E_k), and so on down to the grid's spacing. Distances are to triangles: the file's,
and those of contours that keep their edges (`synth.simulate.object_contour`). The sign of d is that of the generalised
winding number (Jacobson, Kavan & Sorkine-Hornung 2013), which closes holes and fills cavities.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp

from synth.arrays import BoolArray, FloatArray, Points
from synth.scene.surface_file import Triangles
from synth.simulate.object_contour import crossings, sharp_contour

STRIDE = 3
"""Far from the surface one of so many samples along an axis is exact."""
BAND = 2.0
"""Rounding is done so many radii from the surface, and two samples."""
LOST = 1.25
"""What an opening by r leaves out farther than this times r is a thin part or a sharp tip. A right-angled edge loses
0.41 r, its corner 0.73 r, a tetrahedron's edge 0.73 r and its corner 2 r."""
TWICE = 1.5
"""A winding number above this is that of a place within two shells."""
TOUCHING_MM = 1e-4
"""Points that are nearer to a surface have its normal for the gradient of their distance."""
Core = tuple["Nearest", float]


@dataclass(frozen=True, eq=False)
class Grid:
    """Places of samples, corner + spacing (i, j, k), with corner (3,) and spacing in mm."""

    corner: FloatArray
    spacing: float
    counts: tuple[int, int, int]

    def points(self, where: BoolArray) -> Points:
        """The places of some samples."""
        return self.corner + self.spacing * np.argwhere(where)

    def distance(self, surface: "Nearest", where: BoolArray) -> FloatArray:
        """Distances of some samples from a surface, mm; infinite elsewhere."""
        found = np.full(self.counts, np.inf)
        points = self.points(where)
        found[where] = np.linalg.norm(points - surface(points)[0], axis=1)
        return found

    def _away(self, surface: "Nearest", reach_mm: float) -> FloatArray:
        """Distances of all samples from a surface, mm: exact within the reach, beyond it interpolated linearly.

        The farther away a query begins the longer it takes.
        """
        from scipy.interpolate import make_interp_spline

        known = [np.unique([*range(0, count, STRIDE), count - 1]) for count in self.counts]
        some = np.zeros(self.counts, dtype=bool)
        some[np.ix_(*known)] = True
        away = self.distance(surface, some)[np.ix_(*known)]
        for axis, count in enumerate(self.counts):
            away = make_interp_spline(known[axis], away, k=1, axis=axis)(np.arange(count))
        near = away < reach_mm + np.sqrt(3) * STRIDE / 2 * self.spacing
        return np.where(near, self.distance(surface, near), away)

    def signed_distance(self, surface: Triangles, radius_mm: float) -> FloatArray:
        """Distances of all samples, negative inside, and exact where edges are rounded to that radius.

        A closed surface lies between two neighbouring samples of different sign: winding numbers, which take ten times
        as long as distances, are then found near it alone, and the signs of others are those next to them toward +z.
        Where shells overlap, faces of one lie within another: distances are then those from a contour around all.
        """
        nearest, reach = Nearest(surface, winding=True), max(BAND * radius_mm, 4 * self.spacing) + 2 * self.spacing
        away = self._away(nearest, reach)
        known = away < 1.1 * self.spacing if surface.closed else np.ones(self.counts, dtype=bool)
        sign = np.ones((*self.counts[:2], self.counts[2] + 1))  # beyond the last sample is outside
        near = self.points(known)
        sign[:, :, :-1][known] = near_sign = nearest.signs(near)
        above = np.where(known, np.arange(self.counts[2]), self.counts[2])
        above = np.minimum.accumulate(above[:, :, ::-1], axis=2)[:, :, ::-1]
        values = np.asarray(away * np.take_along_axis(sign, above, axis=2))
        if (nearest.signs(near[near_sign < 0], TWICE) > 0).all():
            return values
        outer = sharp_contour(values, self.corner, self.spacing, nearest.depth)
        return np.where(values < 0, -1.0, 1.0) * self._away(Nearest(outer), reach)

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
        band = np.abs(values) < BAND * radius_mm + 2 * self.spacing
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
                found = np.minimum(found, np.where(core <= 0, -away, away) - radius_mm)
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

    def depth(self, points: Points) -> tuple[FloatArray, Points]:
        """The signed distance of points (n, 3) that are inside, and its gradient."""
        nearest, normal = self(points)
        away = np.linalg.norm(nearest - points, axis=1)
        toward = (nearest - points) / np.maximum(away, TOUCHING_MM)[:, None]
        return -away, np.where(away[:, None] < TOUCHING_MM, normal, toward)

    def signs(self, points: Points, least: float = 0.5) -> FloatArray:
        """-1 for points (n, 3) inside, where the winding number is above the least, else 1."""
        found = wp.empty(len(points), dtype=wp.float32, device="cpu")
        inputs = [self._mesh.id, wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu"), least]
        wp.launch(_signs, len(points), inputs=inputs, outputs=[found], device="cpu")
        return found.numpy().astype(np.float64)


FARTHEST = wp.constant(1.0e6)


@wp.kernel
def _nearest(
    mesh: wp.uint64, points: wp.array(dtype=wp.vec3), found: wp.array(dtype=wp.vec3), normal: wp.array(dtype=wp.vec3)
):
    i = wp.tid()
    near = wp.mesh_query_point_no_sign(mesh, points[i], FARTHEST)
    found[i] = wp.mesh_eval_position(mesh, near.face, near.u, near.v)
    normal[i] = wp.mesh_eval_face_normal(mesh, near.face)


@wp.kernel
def _signs(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), least: float, found: wp.array(dtype=wp.float32)):
    i = wp.tid()
    found[i] = wp.mesh_query_point_sign_winding_number(mesh, points[i], FARTHEST, 2.0, least).sign
