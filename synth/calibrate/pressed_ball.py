"""The gel's face under a ball, by the product's own simulation."""

from dataclasses import dataclass
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
from synth.simulate.trajectory import Trajectory
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


@dataclass(frozen=True, eq=False)
class PressedBall:
    """The face's vertices (v, 3) mm under a ball that is pressed in straight, and the contact's radius."""

    surface: GelSurface
    positions: Points
    contact_mm: float


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
        depth = np.clip(np.exp(pose[2]), 0, self.contacts[-1, 0])
        return self.surface.positions(self.displacement(depth)) + np.append(pose[:2], 0.0)

    def depth_mm(self, contact_mm: float) -> float:
        """The depth at which a contact has this radius, at most the deepest."""
        return float(np.interp(contact_mm, np.maximum.accumulate(self.contacts[:, 1]), self.contacts[:, 0]))


def press_ball(sensor: Sensor, radius_mm: float, depth_mm: float, place_mm: FloatArray, friction: float) -> PressedBall:
    """Simulate one press; InputError where the ball does not fit the gel, or the press does not complete."""
    trajectory = _simulated(sensor, radius_mm, depth_mm, place_mm, friction, 1)
    space = trajectory.space
    surface = GelSurface(space.surface, _PARTS)
    positions = surface.positions(trajectory.states[-1].displacement[space.surface_nodes])
    return PressedBall(surface, positions, _contact_mm(positions - [*place_mm, 0.0], radius_mm, depth_mm))


def press_series(sensor: Sensor, radius_mm: float, deepest_mm: float, friction: float) -> BallSeries:
    """Simulate a press in the middle to this depth, or what the gel bears; InputError as of `press_ball`."""
    deepest = min(deepest_mm, _DEEPEST * sensor.gel.size_mm[2])
    trajectory = _simulated(sensor, radius_mm, deepest, np.zeros(2), friction, _STATES)
    space = trajectory.space
    surface, depths = GelSurface(space.surface, _PARTS), np.linspace(0, deepest, _STATES + 1)
    moved = np.stack([state.displacement[space.surface_nodes] for state in trajectory.states])
    contacts = [_contact_mm(surface.positions(each), radius_mm, float(depth))
                for each, depth in zip(moved, depths, strict=True)]  # fmt: skip
    return BallSeries(surface, make_interp_spline(depths, moved), np.column_stack([depths, contacts]), radius_mm)


def _simulated(
    sensor: Sensor, radius_mm: float, depth_mm: float, place_mm: FloatArray, friction: float, steps: int
) -> Trajectory:
    x, y = (float(value) for value in place_mm)
    content = {
        "name": "ball",
        "sensor": sensor.model_dump(),
        "contact": {"indenter": {"shape": "sphere", "radius_mm": radius_mm}, "friction": friction},
        "motion": {"depth_mm": depth_mm, "position_mm": (x, y), "steps": steps},
        "numerics": {"target_error_px": _FINE_MM * pixels_per_mm(sensor)},
    }
    scene = validated(content, f"a ball of {radius_mm:g} mm pressed in by {depth_mm:.2g} mm", Scene)
    trajectory = simulate(scene, MeshRule.of(scene).resolution(scene).mesh)
    if trajectory.status != "complete":
        raise InputError(f"a ball of {radius_mm:g} mm pressed in by {depth_mm:.2g} mm: {trajectory.reason}")
    return trajectory


def _contact_mm(positions: Points, radius_mm: float, depth_mm: float) -> float:
    """Radius of a contact around the origin."""
    away = np.hypot(positions[:, 0], positions[:, 1])
    ball = depth_mm - radius_mm + np.sqrt(np.maximum(radius_mm**2 - away**2, 0))
    touching = (positions[:, 2] - ball < _TOUCHING_MM * depth_mm) & (away < radius_mm)
    return float(away[touching].max(initial=0))
