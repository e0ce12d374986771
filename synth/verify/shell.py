r"""Refraction at a round face seen from within, by shooting: nothing here is shared with `synth.optics.window`.

A ray leaves the eye, is turned at the face by Snell's law in angles, and passes the wanted point at some distance, of
which the components across the straight line from eye to point are to vanish. They are functions of the ray's two
components across that line; their roots are found by Newton's method with finite differences, a step being halved while
it misses by more than the one before.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Points
from synth.scene import Window

_STEPS, _HALVINGS = 40, 20
"""Most steps of Newton's method, and most halvings of one."""
_MISS = 1e-13
"""Largest miss over the distance from eye to point."""
_DIFFERENCE = 1e-6
_ARMS = _DIFFERENCE * np.eye(2)
"""Steps of the differences, along both components of the aim."""


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
        if window.radius_mm is None:
            return None
        centre = window.center_z_mm
        bottom = -np.inf if window.shape == "cylinder" or centre is None else centre
        return Shell(window.radius_mm, bottom, bottom if window.shape == "sphere" else np.inf)

    def outwards(self, points: Points) -> Points:
        """Vectors (n, 3) from the nearest centres to points."""
        return points - np.column_stack(
            [0 * points[:, :2], np.minimum(np.maximum(points[:, 2], self.bottom), self.top)]
        )

    def crossings(self, points: Points, eye: FloatArray, index: float) -> Points:
        """Where light from points (n, 3) outside crosses the face to an eye inside; NaN where no root was found."""
        straight = points - eye
        reach = np.sqrt((straight**2).sum(axis=1, keepdims=True))
        straight = straight / reach
        helper = np.where(np.abs(straight[:, :1]) < 0.6, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        first = np.cross(straight, helper)
        first /= np.sqrt((first**2).sum(axis=1, keepdims=True))
        frame = np.stack([first, np.cross(straight, first)], axis=1)
        aim, found = np.zeros((len(points), 2)), np.full_like(points, np.nan)
        open_ = np.flatnonzero(np.isfinite(points).all(axis=1))

        def shot(at: FloatArray) -> tuple[FloatArray, Points]:
            ray = straight[open_] + np.einsum("ni,nij->nj", at, frame[open_])
            place, onward = self._turned(ray / np.sqrt((ray**2).sum(axis=1, keepdims=True)), eye, index)
            ahead = ((points[open_] - place) * straight[open_]).sum(axis=1) / (onward * straight[open_]).sum(axis=1)
            return np.einsum("nij,nj->ni", frame[open_], place + ahead[:, None] * onward - points[open_]), place

        for _ in range(_STEPS):
            miss, place = shot(aim[open_])
            done = np.abs(miss).max(axis=1) <= _MISS * reach[open_, 0]
            found[open_[done]] = place[done]
            open_, miss = open_[~done], miss[~done]
            if not len(open_):
                break
            sides = [(shot(aim[open_] + arm)[0] - shot(aim[open_] - arm)[0]) / (2 * _DIFFERENCE) for arm in _ARMS]
            (a, c), (b, d) = sides[0].T, sides[1].T
            step = np.column_stack([d * miss[:, 0] - b * miss[:, 1], a * miss[:, 1] - c * miss[:, 0]])
            step /= (a * d - b * c)[:, None]
            size = np.linalg.norm(miss, axis=1)
            for _halving in range(_HALVINGS):
                worse = ~(np.linalg.norm(shot(aim[open_] - step)[0], axis=1) < size)
                worse &= size > 100 * _MISS * reach[open_, 0]
                if not worse.any():
                    break
                step[worse] /= 2
            aim[open_] -= step
        return found

    def _turned(self, rays: Points, eye: FloatArray, index: float) -> tuple[Points, Points]:
        """Where unit rays (n, 3) from the eye meet the face, and their unit directions behind it."""
        across = rays[:, 0] ** 2 + rays[:, 1] ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            side = eye + rays * _later(across, rays[:, :2] @ eye[:2], eye[:2] @ eye[:2] - self.radius**2)[:, None]
            place = np.where(((side[:, 2] >= self.bottom) & (side[:, 2] <= self.top))[:, None], side, np.nan)
            for end, beyond in ((self.bottom, side[:, 2] < self.bottom), (self.top, side[:, 2] > self.top)):
                if np.isfinite(end):
                    arm = eye - (0.0, 0.0, end)
                    place[beyond] = (
                        eye + rays[beyond] * _later(1.0, rays @ arm, arm @ arm - self.radius**2)[beyond, None]
                    )
            normal = self.outwards(place) / self.radius
            cosine = (rays * normal).sum(axis=1, keepdims=True)
            level = rays - cosine * normal
            sine = np.sqrt((level**2).sum(axis=1, keepdims=True))
            angle = np.arcsin(np.minimum(sine / index, 1))
            sideways = np.where(sine > 0, level / sine, 0)
        return place, np.cos(angle) * normal + np.sin(angle) * sideways


def _later(square: FloatArray | float, half: FloatArray, constant: FloatArray | float) -> FloatArray:
    """The later root of square t² + 2 half t + constant = 0."""
    return np.asarray((np.sqrt(half**2 - square * constant) - half) / square)
