r"""Refraction at a round face seen from within, by shooting: nothing here is shared with `synth.optics.window`.

A ray leaves the eye, is turned at the face by Snell's law in angles, and passes the wanted point at some distance, of
which the components across the straight line from eye to point are to vanish. They are functions of the ray's two
components across that line. Their root is found by Broyden's method from a Jacobian of finite differences; where a step
does not reduce the miss, it is halved and the Jacobian is taken anew.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Points
from synth.scene.window import CapsuleWindow, CylinderWindow, SphereWindow, Window

_STEPS = 200
"""Most steps."""
_MISS = 1e-12
"""Largest miss over the distance from eye to point: radians, for lenses of some thousand px to a radian."""
_DIFFERENCE = 1e-6
_ARMS = _DIFFERENCE * np.eye(2)[:, :, None]
"""Steps of the differences, along both components of the aim."""
_UPRIGHT = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True)
class Shell:
    """A sphere, a cylinder about the z axis, or a half sphere with a cylinder above it.

    Below the height `bottom` of the lowest centre, and above `top`, that of the highest, the face is a sphere; a
    `bottom` at -inf: no sphere. All in mm.
    """

    radius: float
    bottom: float
    top: float

    @staticmethod
    def of(window: Window) -> "Shell | None":
        """None for a flat window."""
        match window:
            case SphereWindow():
                return Shell(window.radius_mm, window.center_z_mm, window.center_z_mm)
            case CylinderWindow():
                return Shell(window.radius_mm, -np.inf, np.inf)
            case CapsuleWindow():
                return Shell(window.radius_mm, window.center_z_mm, np.inf)
            case _:
                return None

    def outwards(self, points: Points) -> Points:
        """Vectors (n, 3) from the nearest centres to points."""
        return points - np.column_stack(
            [0 * points[:, :2], np.minimum(np.maximum(points[:, 2], self.bottom), self.top)]
        )

    def crossings(self, points: Points, eye: FloatArray, index: float) -> Points:
        """Where light from points (n, 3) outside crosses the face to an eye inside; NaN where no root was found."""
        found = np.full_like(points, np.nan)
        open_ = np.flatnonzero(np.isfinite(points).all(axis=1))
        target = np.ascontiguousarray(points[open_].T)
        straight = target - eye[:, None]
        reach = np.sqrt(_dot(straight, straight))
        straight /= reach
        first = np.where(np.abs(straight[0]) < 0.6, (0 * reach, straight[2], -straight[1]), _UPRIGHT @ straight)
        first /= np.sqrt(_dot(first, first))
        frame = np.stack([straight, first, np.cross(straight, first, axis=0)])

        def shot(aim: FloatArray) -> tuple[FloatArray, FloatArray]:
            ray = frame[0] + aim[0] * frame[1] + aim[1] * frame[2]
            place, onward = self._turned(ray / np.sqrt(_dot(ray, ray)), eye, index)
            rest = target - place
            past = onward * (_dot(rest, frame[0]) / _dot(onward, frame[0])) - rest
            return np.stack([_dot(past, axis) for axis in frame[1:]]), place

        def slopes() -> FloatArray:
            return np.stack([(shot(aim + arm)[0] - miss) / _DIFFERENCE for arm in _ARMS], axis=1)

        aim, share = np.zeros((2, len(open_))), np.ones(len(open_))
        miss, place = shot(aim)
        jacobian = slopes()
        for _ in range(_STEPS):
            wide = ~(np.abs(miss).max(axis=0) <= _MISS * reach)
            if not wide.all():
                found[open_[~wide]] = place[:, ~wide].T
                open_, target, reach, frame = open_[wide], target[:, wide], reach[wide], frame[..., wide]
                aim, share, miss, jacobian = aim[:, wide], share[wide], miss[:, wide], jacobian[..., wide]
            if not len(open_):
                break
            (a, b), (c, d) = jacobian
            step = np.stack([b * miss[1] - d * miss[0], c * miss[0] - a * miss[1]]) * (share / (a * d - b * c))
            trial, place = shot(aim + step)
            before = _dot(miss, miss)
            worse = ~(_dot(trial, trial) < before) & (before > (100 * _MISS * reach) ** 2)
            if worse.any():
                aim, miss = np.where(worse, aim, aim + step), np.where(worse, miss, trial)
                share = np.where(worse, share / 2, 1.0)
                jacobian = slopes()
            else:
                jacobian += (trial - (1 - share) * miss)[:, None] * (step / _dot(step, step))
                aim, miss, share = aim + step, trial, np.ones(len(open_))
        return found

    def _turned(self, rays: FloatArray, eye: FloatArray, index: float) -> tuple[FloatArray, FloatArray]:
        """Where unit rays (3, n) from the eye meet the face, and their unit directions behind it."""
        with np.errstate(divide="ignore", invalid="ignore"):
            across = rays[0] ** 2 + rays[1] ** 2
            way = _later(across, eye[0] * rays[0] + eye[1] * rays[1], eye[:2] @ eye[:2] - self.radius**2)
            way[across == 0] = np.inf
            height = eye[2] + way * rays[2]
            for end, beyond in ((self.bottom, height < self.bottom), (self.top, height > self.top)):
                if np.isfinite(end):
                    arm = eye - (0.0, 0.0, end)
                    way = np.where(beyond, _later(1.0, arm @ rays, arm @ arm - self.radius**2), way)
            place = eye[:, None] + way * rays
            normal = place / self.radius
            normal[2] -= np.minimum(np.maximum(place[2], self.bottom), self.top) / self.radius
            cosine = _dot(rays, normal)
            level = rays - cosine * normal
            sine = np.sqrt(_dot(level, level))
            angle = np.arcsin(np.minimum(sine / index, 1))
            sideways = level * np.where(sine > 0, np.sin(angle) / sine, 0)
        return place, np.cos(angle) * normal + sideways


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("in,in->n", a, b))


def _later(square: FloatArray | float, half: FloatArray, constant: FloatArray | float) -> FloatArray:
    """The later root of square t² + 2 half t + constant = 0."""
    return np.asarray((np.sqrt(half**2 - square * constant) - half) / square)
