"""What pixels see of a state, without rays: the surface's triangles are projected and the projection is inverted.

`synth.verify.layer` finds all points of the surface that a path shows at a query. Of those whose light really gets to
the camera, it comes from the highest (`ForwardCamera.height`): inside the gel every ray descends from the window.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels, Points, Triangles
from synth.verify.camera import ForwardCamera
from synth.verify.layer import Layer


@dataclass(frozen=True)
class Seen:
    """Material points seen at n queries.

    Attributes:
        triangle: (n,), -1 where nothing is seen.
        weights: (n, 3) barycentric; NaN where nothing is seen.
        height: (n,) mm, of the point in the state looked at; -inf where nothing is seen.
        path: (n,) by which path of the camera; 0 where nothing is seen.
    """

    triangle: NDArray[np.intp]
    weights: FloatArray
    height: FloatArray
    path: NDArray[np.intp]

    def positions(self, triangles: Triangles, positions: Points) -> Points:
        """Where the points are when the surface's vertices are at `positions`: (n, 3), NaN where nothing is seen."""
        return np.einsum("ni,nic->nc", self.weights, positions[triangles[self.triangle]])


@dataclass(frozen=True, eq=False)
class Sheet:
    """One state of the surface before the camera, whose image has so many px.

    Attributes:
        triangles: (f, 3).
        positions: (v, 3) mm.
    """

    camera: ForwardCamera
    triangles: Triangles
    positions: Points
    width: int
    height: int

    def seen(self, queries: Pixels) -> Seen:
        """The material points seen at queries (n, 2) px inside the image (or at most a pixel outside)."""
        parts = [self._found(layer, queries) for layer in self._layers]
        query, triangle, weights, path = (np.concatenate(part) for part in zip(*parts, strict=True))
        height = self.camera.height(np.einsum("ni,nic->nc", weights, self.positions[self.triangles[triangle]]))
        order = np.lexsort((triangle, -height, query))
        query, first = np.unique(query[order], return_index=True)
        best, n = order[first], len(queries)
        seen = Seen(np.full(n, -1), np.full((n, 3), np.nan), np.full(n, -np.inf), np.zeros(n, dtype=np.intp))
        for field, values in (
            (seen.triangle, triangle),
            (seen.weights, weights),
            (seen.height, height),
            (seen.path, path),
        ):
            field[query] = values[best]
        return seen

    def pixels(self, points: Points, path: NDArray[np.intp]) -> Pixels:
        """Where points (n, 3) are seen, each by its path (n,)."""
        pixels = np.full((len(points), 2), np.nan)
        for number in self.camera.paths:
            at = path == number
            pixels[at] = self.camera.see(points[at], number)
        return pixels

    def reached_by(self, points: Points, path: NDArray[np.intp]) -> BoolArray:
        """Whether points (n, 3) are seen by their paths (n,) as far as mirrors decide it."""
        free = np.ones(len(points), dtype=np.bool_)
        if self.camera.plates:
            for number in self.camera.paths:
                at = path == number
                free[at] = self.camera.reaches(points[at], number)
        return free

    @cached_property
    def _layers(self) -> tuple[Layer, ...]:
        size = (self.width, self.height)
        camera = self.camera.around(*size)
        return tuple(Layer(camera, path, self.triangles, self.positions, *size) for path in self.camera.paths)

    def _found(
        self, layer: Layer, queries: Pixels
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray, NDArray[np.intp]]:
        """What a layer shows at the queries, less what lens and mirrors do not; and its path, repeated."""
        query, triangle, weights = layer.found(queries)
        if self.camera.plates or self.camera.is_fisheye:
            points = np.einsum("ni,nic->nc", weights, self.positions[self.triangles[triangle]])
            free = self.camera.is_in_field(points, layer.path)
            if self.camera.plates:
                free &= self.camera.reaches(points, layer.path)
            query, triangle, weights = query[free], triangle[free], weights[free]
        return query, triangle, weights, np.full(len(query), layer.path)
