"""The gel's surface in the renderer's frame.

The scene's axes are a left-handed triple (+x right, +y down, +z toward the viewer); Mitsuba's are right-handed. So y is
mirrored in what Mitsuba gets, for geometry, lights and camera alike, and nothing needs mirroring in what it returns.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Points
from synth.render.aligned import aligned
from synth.render.chart import Chart
from synth.surface import GelSurface, vertex_normals

MIRROR = np.array([1.0, -1.0, 1.0])
"""Componentwise factor from the scene's frame to the renderer's and back."""


@dataclass(frozen=True, eq=False)
class GelMesh:
    """Topology and texture coordinates of a surface before it is deformed, and the arrays that Mitsuba takes per frame.

    The chart says how the texture is laid on it. `behind` is z (mm) of the plane in which the arrays show the mirror
    image of the gel; None: they show the gel.
    """

    surface: GelSurface
    chart: Chart
    behind: float | None = None

    def faces(self) -> NDArray[np.uint32]:
        """(3 f,) vertex indices; turned over, because mirroring y turns every triangle's normal (and z, back)."""
        triangles = self.surface.triangles
        return np.ascontiguousarray(triangles[:, ::-1] if self.behind is None else triangles).astype(np.uint32).ravel()

    @cached_property
    def incident(self) -> NDArray[np.uint32]:
        """(v, k) faces at each vertex in rising order; the number of faces, f, stands for none."""
        corners = self.surface.triangles.ravel()
        order = np.argsort(corners, kind="stable")
        vertices, count = corners[order], np.bincount(corners, minlength=len(self.surface.material))
        found = np.full((len(count), count.max()), len(self.surface.triangles), dtype=np.uint32)
        found[vertices, np.arange(len(order)) - (np.cumsum(count) - count)[vertices]] = order // 3
        return found

    def texture_coordinates(self) -> NDArray[np.float32]:
        """(2 v,) u along +x and v along +y, each 0..1 over the chart; Mitsuba's v = 0 is a texture's first row."""
        places, (width, height) = self.chart.flattened(self.surface.material), self.chart.size_mm
        return aligned(places / (width, height) + 0.5)

    def positions(self, positions: Points) -> NDArray[np.float32]:
        """(3 v,) in the renderer's frame, from positions (v, 3) float64 mm."""
        if self.behind is not None:
            positions = mirrored(positions, self.behind)
        return aligned(positions * MIRROR)

    def normals(self, positions: Points) -> NDArray[np.float32]:
        """(3 v,) area-weighted unit normals in the renderer's frame, from positions (v, 3) float64 mm.

        For scalar variants: Mitsuba's own sums are atomic, so their rounding depends on the number of threads.
        """
        # Components of a cross product of mirrored vectors are the mirrored components, negated. The faces are turned
        # over as well, which negates once more.
        normals = vertex_normals(positions, self.surface.triangles)
        if self.behind is not None:
            normals = mirrored(normals, 0.0)
        return (normals * MIRROR).astype(np.float32).ravel()


def mirrored(vectors: Points, plane_z: float) -> Points:
    """Positions (n, 3) mm mirrored in the plane z = plane_z; with 0, directions."""
    return np.asarray(vectors * [1.0, 1.0, -1.0] + [0.0, 0.0, 2 * plane_z])
