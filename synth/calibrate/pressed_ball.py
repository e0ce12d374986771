"""The gel's face under a ball, by the product's own simulation."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from synth.arrays import FloatArray, Points
from synth.errors import InputError
from synth.press.press import MeshRule
from synth.render.pattern import pixels_per_mm
from synth.scene import Scene, Sensor
from synth.scene.validation import validated
from synth.simulate import simulate
from synth.surface import GelSurface

_TOUCHING_MM = 0.02
"""Gap, per mm of depth, below which the face counts as touching the ball."""

_PARTS = 3
"""Triangles along the edge of each of the simulation's faces."""

_STATES = 8
"""Depths of a `BallSeries`, between which faces are interpolated by cubic splines."""
_FINE_MM = 0.004
"""Error of the face that the mesh is made for: a tenth of that moves a flank's slope by some per cent."""
_DEEPEST = 0.8
"""Share of the gel's thickness that a ball of a series is pressed in at most."""
_MOVED = 0.9
"""Share of the distance from a press to the gel's edge within which the face is moved as one."""


@dataclass(frozen=True, eq=False)
class BallSeries:
    """Faces under one ball by its depth, simulated once in the middle of the gel and moved to where a press is.

    Beside a gel's edge this is a little stiffer than the gel. `displacement` is a spline of the nodes' (n, 3), mm, over
    the depth; `contacts` (k, 2) are depths and the contacts' radii there, mm.
    """

    surface: GelSurface
    displacement: Any
    contacts: FloatArray
    radius_mm: float

    def face(self, pose: FloatArray) -> Points:
        """Vertices (v, 3) mm under a press with the pose (3,): its place, mm, and the logarithm of its depth in mm."""
        return self.surface.positions(self._moved(pose)) + np.append(pose[:2], 0.0)

    def pressed(self, pose: FloatArray) -> tuple[GelSurface, Points]:
        """The same as a surface and its vertices, with edges and pattern where the gel's are."""
        nodes = self.surface.coarse.nodes.copy()
        for axis, place in enumerate(pose[:2]):
            half = np.abs(nodes[:, axis]).max()
            near = _MOVED * max(half - abs(place), 0)
            ends = [-half, place - near, place + near, half]
            nodes[:, axis] = np.interp(nodes[:, axis], [-half, -near, near, half], ends)
        surface = GelSurface(replace(self.surface.coarse, nodes=nodes), _PARTS)
        return surface, surface.positions(self._moved(pose))

    def _moved(self, pose: FloatArray) -> FloatArray:
        return np.asarray(self.displacement(min(float(np.exp(pose[2])), self.contacts[-1, 0])))

    def depth_mm(self, contact_mm: float) -> float:
        """The depth at which a contact has this radius, at most the deepest."""
        return float(np.interp(contact_mm, np.maximum.accumulate(self.contacts[:, 1]), self.contacts[:, 0]))


def press_series(sensor: Sensor, radius_mm: float, deepest_mm: float, friction: float) -> BallSeries:
    """Simulate a press in the middle to this depth, or what the gel bears; InputError where it does not complete."""
    deepest = min(deepest_mm, _DEEPEST * sensor.gel.size_mm[2])
    content = {
        "name": "ball",
        "sensor": sensor.model_dump(),
        "contact": {"indenter": {"shape": "sphere", "radius_mm": radius_mm}, "friction": friction},
        "motion": {"depth_mm": deepest, "steps": _STATES},
        "numerics": {"target_error_px": _FINE_MM * pixels_per_mm(sensor)},
    }
    where = f"a ball of {radius_mm:g} mm pressed in by {deepest:.2g} mm"
    scene = validated(content, where, Scene)
    trajectory = simulate(scene, MeshRule.of(scene).resolution(scene).mesh)
    if trajectory.status != "complete":
        raise InputError(f"{where}: {trajectory.reason}")
    space = trajectory.space
    surface, depths = GelSurface(space.surface, _PARTS), np.linspace(0, deepest, _STATES + 1)
    moved = np.stack([state.displacement[space.surface_nodes] for state in trajectory.states])
    contacts = [_contact_mm(surface.positions(each), radius_mm, float(depth))
                for each, depth in zip(moved, depths, strict=True)]  # fmt: skip
    return BallSeries(surface, make_interp_spline(depths, moved), np.column_stack([depths, contacts]), radius_mm)


def _contact_mm(positions: Points, radius_mm: float, depth_mm: float) -> float:
    """Radius of a contact around the origin."""
    away = np.hypot(positions[:, 0], positions[:, 1])
    ball = depth_mm - radius_mm + np.sqrt(np.maximum(radius_mm**2 - away**2, 0))
    touching = (positions[:, 2] - ball < _TOUCHING_MM * depth_mm) & (away < radius_mm)
    return float(away[touching].max(initial=0))
