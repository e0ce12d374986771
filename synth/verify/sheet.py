"""What pixels see of a state, without rays: the surface's triangles are projected and the projection is inverted.

A `Layer` tells all points of the surface that a path shows at a query. Of those whose light really gets to
the camera, it comes from the highest (`ForwardCamera.height`): inside the gel every ray descends from the window.

Layers: every vertex is projected (`ForwardCamera.see`); a triangle's image is then nearly, but because of perspective,
refraction and lens not exactly, the triangle of its corners' images. How far the two differ is measured at its edges'
midpoints: for a map that is quadratic over a triangle the interior differs by at most 4/3 of the largest of these, so
triangles widened by twice that hold their true image. For each query and each widened triangle around it, Newton's
method looks for the point of the (flat) triangle in space whose projection is the query.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels, Points, Triangles
from synth.errors import InputError
from synth.verify.camera import ForwardCamera

_CONVERGED_PX = 1e-8
"""Distance from the query at which Newton's method has arrived."""
_INSIDE = -1e-7
"""Barycentric coordinates from here up count as inside: edges belong to both triangles; Newton leaves about 1e-9."""
_CHORD_STEPS, _NEWTON_STEPS, _LONGEST_STEP = 8, 20, 0.5
"""Most steps with the constant Jacobian and with Newton's, and the longest step in barycentric coordinates."""
_MOST_OVERLAP = 32
"""Pixels that the triangles touch, over pixels and triangles; surfaces of the shipped scenes have 2.4 to 2.6."""
_STARTS = np.array([(i, j, 3 - i - j) for i in range(4) for j in range(4 - i)]) / 3


@dataclass(frozen=True, eq=False)
class Layer:
    """One state of the surface, triangles (f, 3) and positions (v, 3) mm, as one path of the camera shows it.

    The camera's image has `width` x `height` px.
    """

    camera: ForwardCamera
    path: int
    triangles: Triangles
    positions: Points
    width: int
    height: int

    def found(self, queries: Pixels) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
        """Every point of the surface that projects to one of the queries (n, 2), hidden ones included.

        Of each point its query, its triangle and its weights (m, 3) there.
        """
        query, triangle, weights = self._candidates(queries)
        weights, found = self._solve(queries[query], triangle, weights)
        return query[found], triangle[found], weights[found]

    @cached_property
    def _corners(self) -> FloatArray:
        """(f, 3, 2) px."""
        return self.camera.see(self.positions, self.path)[self.triangles]

    @cached_property
    def _slack(self) -> FloatArray:
        """(f,) px by which a triangle's image may leave the triangle of its corners' images."""
        corners, solid = self._corners, self.positions[self.triangles]
        worst = np.zeros(len(corners))
        for i in range(3):
            middle = self.camera.see((solid[:, i] + solid[:, i - 1]) / 2, self.path)
            worst = np.maximum(worst, np.linalg.norm(middle - (corners[:, i] + corners[:, i - 1]) / 2, axis=1))
        return 2 * worst + 1e-6

    @cached_property
    def _reach(self) -> FloatArray:
        """(f, 3) slack in barycentric coordinates: over the triangle's three heights."""
        a, b, c = np.moveaxis(self._corners, 1, 0)
        sides = np.column_stack([np.linalg.norm(side, axis=1) for side in (c - b, a - c, b - a)])
        with np.errstate(divide="ignore", invalid="ignore"):
            return self._slack[:, None] * sides / np.abs(_cross(b - a, c - a))[:, None]

    @cached_property
    def _cells(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Triangles touching each pixel of the image with a rim of one pixel: starts of the lists, and the lists."""
        slack = self._slack[:, None]
        low, high = self._corners.min(1) - slack, self._corners.max(1) + slack
        limits = np.array([self.width, self.height])
        near = np.isfinite(low + high).all(1) & (high >= -1).all(1) & (low < limits + 1).all(1)
        member = np.flatnonzero(near)
        first = np.clip(np.floor(low[near]), -1, limits).astype(int) + 1
        last = np.clip(np.floor(high[near]), -1, limits).astype(int) + 1
        span = last - first + 1
        count = span.prod(1)
        if count.sum() > _MOST_OVERLAP * (self.width * self.height + len(member)):
            raise InputError("the surface's triangles lie over one another in the picture; the surface is torn")
        owner = np.repeat(np.arange(len(member)), count)
        place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        row, column = np.divmod(place, span[owner, 0])
        cell = (first[owner, 1] + row) * (self.width + 2) + first[owner, 0] + column
        order = np.argsort(cell, kind="stable")
        starts = np.searchsorted(cell[order], np.arange((self.width + 2) * (self.height + 2) + 1))
        return starts, member[owner[order]]

    def _candidates(self, queries: Pixels) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray]:
        """Pairs of a query and a triangle that may show there, with barycentric coordinates in the image."""
        starts, members = self._cells
        at = np.floor(queries).astype(int) + 1
        cell = at[:, 1] * (self.width + 2) + at[:, 0]
        count = starts[cell + 1] - starts[cell]
        query = np.repeat(np.arange(len(queries)), count)
        triangle = members[np.arange(count.sum()) + np.repeat(starts[cell] + count - np.cumsum(count), count)]
        a, b, c = np.moveaxis(self._corners[triangle], 1, 0)
        q = queries[query]
        with np.errstate(divide="ignore", invalid="ignore"):
            area = _cross(b - a, c - a)
            weights = (
                np.column_stack([_cross(c - b, q - b), _cross(a - c, q - c), _cross(b - a, q - a)]) / area[:, None]
            )
            near = (weights >= -self._reach[triangle] - 1e-6).all(1)
        return query[near], triangle[near], weights[near]

    def _solve(
        self, queries: Pixels, triangle: NDArray[np.intp], weights: FloatArray
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Points of the triangles that project to the queries: their weights, and which were found inside.

        The image triangle's constant Jacobian serves where the bending of its image is small against its width. What
        is left are triangles seen nearly edge-on, or across the ring where a round window's curvature jumps: there
        Newton's method starts from each of ten places.
        """
        solid, corners = self.positions[self.triangles[triangle]], self._corners[triangle]
        weights, solved = self._descend(queries, solid, weights, _CHORD_STEPS, corners[:, 1:] - corners[:, :1])
        left = np.flatnonzero(~solved)
        for start in _STARTS if len(left) else ():
            trial, converged = self._descend(queries[left], solid[left], np.tile(start, (len(left), 1)), _NEWTON_STEPS)
            good = converged & (trial >= _INSIDE).all(1)
            weights[left[good]], solved[left[good]] = trial[good], True
            left = left[~good]
        return weights, solved & (weights >= _INSIDE).all(1)

    def _descend(
        self, queries: Pixels, solid: FloatArray, weights: FloatArray, steps: int, fixed: FloatArray | None = None
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Steps toward the queries by a fixed Jacobian (n, 2, 2) or by Newton's; the weights, and which arrived."""
        weights = weights.copy()
        open_ = np.arange(len(queries))
        for _ in range(steps):
            miss = queries[open_] - self._image(solid[open_], weights[open_])
            far = ~(np.linalg.norm(miss, axis=1) <= _CONVERGED_PX)
            open_, miss = open_[far], miss[far]
            if not len(open_):
                break
            jacobian = self._differences(solid[open_], weights[open_]) if fixed is None else fixed[open_]
            along, across = jacobian[:, 0], jacobian[:, 1]
            with np.errstate(divide="ignore", invalid="ignore"):
                move = np.column_stack([_cross(miss, across), _cross(along, miss)]) / _cross(along, across)[:, None]
                move *= np.minimum(1, _LONGEST_STEP / np.abs(move).max(1, keepdims=True))
            weights[open_] += np.column_stack([-move.sum(1), move])
        solved = np.ones(len(queries), dtype=np.bool_)
        solved[open_] = False
        return weights, solved

    def _image(self, solid: FloatArray, weights: FloatArray) -> Pixels:
        return self.camera.see(np.einsum("ni,nic->nc", weights, solid), self.path)

    def _differences(self, solid: FloatArray, weights: FloatArray) -> FloatArray:
        """(n, 2, 2): central differences of the image in the second and third weight."""
        columns = []
        for direction in (np.array([-1.0, 1.0, 0.0]), np.array([-1.0, 0.0, 1.0])):
            ahead, behind = (self._image(solid, weights + sign * 1e-4 * direction) for sign in (1, -1))
            columns.append((ahead - behind) / 2e-4)
        return np.stack(columns, axis=1)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


@dataclass(frozen=True)
class Seen:
    """Material points seen at n queries."""

    triangle: NDArray[np.intp]  # (n,), -1 where nothing is seen
    weights: FloatArray  # (n, 3) barycentric; NaN where nothing is seen
    height: FloatArray  # (n,) mm, of the point in the state looked at; -inf where nothing is seen
    path: NDArray[np.intp]  # (n,) by which path of the camera; 0 where nothing is seen

    def positions(self, triangles: Triangles, positions: Points) -> Points:
        """Where the points are when the surface's vertices are at `positions`: (n, 3), NaN where nothing is seen."""
        return np.einsum("ni,nic->nc", self.weights, positions[triangles[self.triangle]])


@dataclass(frozen=True, eq=False)
class Sheet:
    """A state, triangles (f, 3) and positions (v, 3) mm, before a camera whose image has `width` x `height` px."""

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
        for field, values in zip(vars(seen).values(), (triangle, weights, height, path), strict=True):
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
        """What a layer shows at the queries, without what lens and mirrors do not show; and its path, repeated."""
        query, triangle, weights = layer.found(queries)
        if self.camera.plates or self.camera.is_fisheye:
            points = np.einsum("ni,nic->nc", weights, self.positions[self.triangles[triangle]])
            free = self.camera.is_in_field(points, layer.path)
            if self.camera.plates:
                free &= self.camera.reaches(points, layer.path)
            query, triangle, weights = query[free], triangle[free], weights[free]
        return query, triangle, weights, np.full(len(query), layer.path)
