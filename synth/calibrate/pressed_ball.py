"""The gel's face under a ball, by the product's own simulation."""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Points
from synth.errors import InputError
from synth.press.press import MeshRule
from synth.scene import Scene, Sensor
from synth.scene.validation import validated
from synth.simulate import simulate
from synth.surface import GelSurface

_TOUCHING_MM = 0.02
"""Gap, per mm of depth, below which the face counts as touching the ball."""

_PARTS = 6
"""Triangles along the edge of each of the simulation's faces."""


@dataclass(frozen=True, eq=False)
class PressedBall:
    """The face's vertices (v, 3) mm under a ball that is pressed in straight, and the contact's radius."""

    surface: GelSurface
    positions: Points
    contact_mm: float


def press_ball(sensor: Sensor, radius_mm: float, depth_mm: float, place_mm: FloatArray, friction: float) -> PressedBall:
    """Simulate one press; InputError where the ball does not fit the gel, or the press does not complete."""
    x, y = (float(value) for value in place_mm)
    content = {
        "name": "ball",
        "sensor": sensor.model_dump(),
        "contact": {"indenter": {"shape": "sphere", "radius_mm": radius_mm}, "friction": friction},
        "motion": {"depth_mm": depth_mm, "position_mm": (x, y), "steps": 1},
    }
    scene = validated(content, f"a ball of {radius_mm:g} mm pressed in by {depth_mm:.2g} mm", Scene)
    trajectory = simulate(scene, MeshRule.of(scene).resolution(scene).mesh)
    if trajectory.status != "complete":
        raise InputError(f"a ball of {radius_mm:g} mm pressed in by {depth_mm:.2g} mm: {trajectory.reason}")
    space = trajectory.space
    surface = GelSurface(space.surface, _PARTS)
    positions = surface.positions(trajectory.states[-1].displacement[space.surface_nodes])
    away = np.hypot(positions[:, 0] - x, positions[:, 1] - y)
    ball = depth_mm - radius_mm + np.sqrt(np.maximum(radius_mm**2 - away**2, 0))
    touching = (positions[:, 2] - ball < _TOUCHING_MM * depth_mm) & (away < radius_mm)
    return PressedBall(surface, positions, float(away[touching].max(initial=0)))
