r"""The flat outer face of the window, at which light bends once; gel and window have one refractive index n.

A point at depth h_p below that face and at lateral distance R from an eye at height h_c above it is seen at the slope t
(lateral run per unit of height, in air) that solves

.. math::  R = h_c t + \frac{h_p t}{\sqrt{n^2 + (n^2 - 1) t^2}}

which is Snell's law written for t. The right side is increasing and concave in t, so Newton's method started at
t = R / (h_c + h_p / n), which lies left of the root, climbs to it monotonically: no safeguard ever has to act.
The code solves for m = t / R, which stays finite on the axis (R = 0).

A round inner face, seen from within, is a sphere, a cylinder or a capsule. All three are the points at the distance r
from a part of the z axis: from a point, from the whole axis, and from all of the axis above a point. They enclose air,
which is convex, and the camera; what is outside, window and gel, has one refractive index n. A ray in air with the unit
direction d leaves where the face's unit normal is N, and goes on along

.. math::  \frac{d}{n} + \left(\cos θ' - \frac{\cos θ}{n}\right) N, \qquad \sin θ = n \sin θ' .

The inverse is Fermat's principle: light from an eye e to a point p of the body crosses the face where the optical
length L(s) = |s - e| + n |p - s| is stationary. Along the face its second derivative in a direction t is

.. math::  \frac{1 - (a \cdot t)^2}{|s - e|} + n \frac{1 - (b \cdot t)^2}{|p - s|} + (n\, b - a) \cdot N \; κ_t

with a and b the unit vectors from e to s and from s to p, and κ the face's curvature, 1 / r or 0. It is positive
wherever b is no farther from the normal than Snell's law allows: rays of one eye never meet in the body, and each point
has one crossing, a minimum. Newton's method in the face's two directions starts where the straight line crosses, and a
step that would lengthen the way is halved.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points

_RELATIVE_STEP = 1e-9
"""Newton's error after a relative step s is of order s²; below 1e-9 the next iterate is exact to rounding."""
_MAX_ITERATIONS = 40


@dataclass(frozen=True)
class Window:
    """The face z = `face_z` mm between air above and a body of refractive index `index` below."""

    index: float
    face_z: float

    def aim(self, points: Points, eye: FloatArray) -> Points:
        """Directions (n, 3), of any length, in which an eye (3,) in air sees points (n, 3) below the face.

        NaN for points above the face and for an eye below it, where the face refracts.
        """
        arm = points - eye
        if self.index == 1:
            return arm
        if eye[2] <= self.face_z:
            return np.full_like(arm, np.nan)
        return np.column_stack([arm[:, :2] * self._slope_per_distance(points, eye)[:, None], np.full(len(arm), -1.0)])

    def enter(self, eye: FloatArray, air: Points) -> tuple[Points, Points]:
        """Rays in the body that continue rays in air from an eye (3,) mm in unit directions (n, 3).

        Origins (n, 3) mm on the face (at index 1: the eye) and unit directions (n, 3); NaN where a ray does not go
        down.
        """
        air = np.where(air[:, 2:] < 0, air, np.nan)
        if self.index == 1:
            return np.where(np.isnan(air), np.nan, eye), air
        origins = eye + air * ((self.face_z - eye[2]) / air[:, 2])[:, None]
        origins[:, 2] += self.face_z - origins[:, 2]  # exactly on the face; NaN stays NaN
        lateral = air[:, :2] / self.index
        return origins, np.column_stack([lateral, -np.sqrt(1 - (lateral**2).sum(1))])

    def shows(self, points: Points) -> BoolArray:
        """Which of the points (n, 3) a camera might see: those between the gel's face and this one."""
        return np.asarray((points[:, 2] > 0) & (points[:, 2] < self.face_z))

    def _slope_per_distance(self, points: Points, eye: FloatArray) -> FloatArray:
        """The root m = t / R (n,) 1/mm of the module's equation for points (n, 3)."""
        above, below = eye[2] - self.face_z, self.face_z - points[:, 2]
        below = np.where(below >= 0, below, np.nan)
        n2 = self.index**2
        x, y = points[:, 0] - eye[0], points[:, 1] - eye[1]
        bend = (n2 - 1) * (x * x + y * y)
        slope = 1 / (above + below / self.index)
        for _ in range(_MAX_ITERATIONS):
            square = n2 + bend * (slope * slope)
            root = np.sqrt(square)
            step = (1 - above * slope - below * slope / root) / (above + below * n2 / (root * square))
            slope = slope + step
            if not np.any(np.abs(step) > _RELATIVE_STEP * slope):
                break
        return slope


_MAX_ROUND_ITERATIONS = 60
_MAX_HALVINGS = 30
_ROUNDING = 1e-14
"""Relative, of lengths and coordinates."""


@dataclass(frozen=True)
class RoundWindow:
    """The face at `radius` mm from the part of the axis from `low` to `high` mm; index 1: matched, nothing bends.

    The face goes on where the gel has ended. A cylinder is open at both ends, a capsule above.
    """

    index: float
    radius: float
    low: float
    high: float

    def aim(self, points: Points, eye: FloatArray) -> Points:
        """Directions (n, 3), of any length, in which an eye (3,) within the face sees points (n, 3), inside or outside.

        NaN where Newton's method did not converge.
        """
        crossing, converged = self.crossings(points, eye)
        return np.where(converged[:, None], crossing, np.nan) - eye

    def enter(self, eye: FloatArray, air: Points) -> tuple[Points, Points]:
        """Rays in the body that continue rays in air from an eye (3,) mm in unit directions (n, 3).

        Origins (n, 3) mm on the face (at index 1: the eye) and unit directions (n, 3); NaN where a ray leaves by an
        open end.
        """
        if self.index == 1:
            return np.where(np.isnan(air), np.nan, eye), air
        with np.errstate(invalid="ignore"):
            origins = eye + air * self._way_out(eye, air)[:, None]
            normal = (origins - self._foot(origins)) / self.radius
            slant = (air * normal).sum(axis=1, keepdims=True)
            bent = np.sqrt(1 - (1 - slant**2) / self.index**2)
            inside = air / self.index + (bent - slant / self.index) * normal
        missing = ~np.isfinite(inside).all(axis=1)
        origins[missing], inside[missing] = np.nan, np.nan
        return origins, inside

    def shows(self, points: Points) -> BoolArray:
        """Which of the points (n, 3) a camera might see: all, in air and in the body."""
        return np.ones(len(points), dtype=np.bool_)

    def holds(self, points: Points) -> BoolArray:
        """Whether points (n, 3) lie within the face, in air."""
        return np.asarray(np.linalg.norm(points - self._foot(points), axis=1) < self.radius)

    def crossings(self, points: Points, eye: FloatArray) -> tuple[Points, BoolArray]:
        """Where (n, 3) mm light from points (n, 3) to an eye (3,) crosses the face, and which converged (n,).

        For points in air, and at index 1, the points themselves. NaN does not converge.
        """
        found, converged = points.copy(), np.asarray(np.isfinite(points).all(axis=1))
        at = np.flatnonzero(converged & ~self.holds(points)) if self.index != 1 else np.arange(0)
        arm = points[at] - eye
        direction = arm / np.linalg.norm(arm, axis=1, keepdims=True)
        found[at] = eye + direction * self._way_out(eye, direction)[:, None]
        for _ in range(_MAX_ROUND_ITERATIONS):
            start, target = found[at], points[at]
            step, scale = self._newton(start, target, eye)
            found[at] = self._shortened(start, step, target, eye)
            small = np.maximum(_RELATIVE_STEP * scale, _ROUNDING * self.radius)
            at = at[~(np.linalg.norm(step, axis=1) <= small)]
            if not len(at):
                break
        converged[at] = False
        return found, converged

    def _foot(self, points: Points) -> Points:
        """The nearest points (n, 3) of the axis's part."""
        foot = np.zeros_like(points)
        foot[:, 2] = np.clip(points[:, 2], self.low, self.high)
        return foot

    def _way_out(self, eye: FloatArray, air: Points) -> FloatArray:
        """Distances (n,) mm from an eye within the face to the face along unit directions (n, 3); not finite: never."""
        with np.errstate(divide="ignore", invalid="ignore"):
            square = (air[:, :2] ** 2).sum(axis=1)
            side = _far_root(square, air[:, :2] @ eye[:2], eye[:2] @ eye[:2] - self.radius**2)
            side = np.where(square > 0, side, np.inf)
            height = eye[2] + side * air[:, 2]
            end = np.clip(height, self.low, self.high)
            arm = np.column_stack([np.broadcast_to(eye[:2], (len(air), 2)), eye[2] - end])
            cap = _far_root(1.0, (arm * air).sum(axis=1), (arm**2).sum(axis=1) - self.radius**2)
        return np.where(height == end, side, cap)

    def _newton(self, crossing: Points, points: Points, eye: FloatArray) -> tuple[Points, FloatArray]:
        """Steps (n, 3) mm in the planes that touch the face at crossings (n, 3), and the paths' shorter parts (n,)."""
        foot = self._foot(crossing)
        normal = (crossing - foot) / self.radius
        level = np.hypot(normal[:, 0], normal[:, 1])[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            around = np.where(level > 0, np.column_stack([-normal[:, 1], normal[:, 0], 0 * level]) / level, (1.0, 0, 0))
        along = np.cross(normal, around)
        incoming, onward = crossing - eye, points - crossing
        before, after = (np.linalg.norm(arm, axis=1) for arm in (incoming, onward))
        incoming, onward = incoming / before[:, None], onward / np.maximum(after, 1e-300)[:, None]
        (a1, a2), (b1, b2) = ([(arm * axis).sum(axis=1) for axis in (around, along)] for arm in (incoming, onward))
        curvature = ((self.index * onward - incoming) * normal).sum(axis=1) / self.radius
        near, far = 1 / before, self.index / np.maximum(after, 1e-300)
        is_capped = crossing[:, 2] != foot[:, 2]
        h11 = (1 - a1**2) * near + (1 - b1**2) * far + curvature
        h22 = (1 - a2**2) * near + (1 - b2**2) * far + curvature * is_capped
        h12 = -a1 * a2 * near - b1 * b2 * far
        g1, g2 = a1 - self.index * b1, a2 - self.index * b2
        determinant = h11 * h22 - h12**2
        first, second = (h12 * g2 - h22 * g1) / determinant, (h12 * g1 - h11 * g2) / determinant
        return first[:, None] * around + second[:, None] * along, np.minimum(before, after)

    def _shortened(self, start: Points, step: Points, points: Points, eye: FloatArray) -> Points:
        """Crossings after steps (n, 3), halved where the optical length would grow."""
        limit = self._length(start, points, eye) * (1 + _ROUNDING)
        share = np.ones((len(start), 1))
        for _ in range(_MAX_HALVINGS):
            moved = start + share * step
            foot = self._foot(moved)
            arm = moved - foot
            moved = foot + arm * (self.radius / np.linalg.norm(arm, axis=1, keepdims=True))
            longer = self._length(moved, points, eye) > limit
            if not longer.any():
                break
            share[longer] /= 2
        return moved

    def _length(self, crossing: Points, points: Points, eye: FloatArray) -> FloatArray:
        before, after = np.linalg.norm(crossing - eye, axis=1), np.linalg.norm(points - crossing, axis=1)
        return np.asarray(before + self.index * after)


def _far_root(square: FloatArray | float, half: FloatArray, constant: FloatArray | np.floating) -> FloatArray:
    """The larger root of square t² + 2 half t + constant = 0 with a constant below 0, without cancellation."""
    root = np.sqrt(half**2 - square * constant)
    return np.where(half > 0, -constant / (half + root), (root - half) / square)
