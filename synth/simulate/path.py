"""Where the indenter is along its way: first down, then sideways and round at once.

The path parameter is a length in mm: depth while pressing, then the distance that the farthest touching point moves
while shearing and twisting.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray
from synth.scene import Motion
from synth.simulate.indenter import RigidBody, rotation_about

TWIST_ARM_MM = 3.0
"""Lever that turns a twist angle into a path length: about a contact's radius."""


@dataclass(frozen=True)
class Pose:
    """The indenter at one point of its path, in the terms of the scene and of the kernels."""

    depth_mm: float
    shear_mm: tuple[float, float]
    twist_deg: float
    centre: FloatArray
    rotation: FloatArray


@dataclass(frozen=True)
class Path:
    """The way of one indenter."""

    motion: Motion
    body: RigidBody

    @property
    def press_mm(self) -> float:
        """Length of the first leg."""
        return max(self.motion.depth_mm, 0.0)

    @property
    def drag_mm(self) -> float:
        """Length of the second leg."""
        turned = abs(np.radians(self.motion.twist_deg)) * TWIST_ARM_MM
        return float(np.hypot(*self.motion.shear_mm) + turned)

    def pose(self, s: float) -> Pose:
        """The indenter at path length s, 0 <= s <= press_mm + drag_mm."""
        motion = self.motion
        depth = min(s, motion.depth_mm) if motion.depth_mm > 0 else motion.depth_mm
        share = float(np.clip((s - self.press_mm) / self.drag_mm, 0, 1)) if self.drag_mm > 0 else 0.0
        shear = (share * motion.shear_mm[0], share * motion.shear_mm[1])
        twist = share * motion.twist_deg
        centre = np.array(
            [motion.position_mm[0] + shear[0], motion.position_mm[1] + shear[1], depth - self.body.reach_mm]
        )
        return Pose(depth, shear, twist, centre, rotation_about(2, np.radians(twist)) @ self.body.rotation)

    def records(self) -> FloatArray:
        """(steps,) path lengths at which states are recorded: both legs in equal parts, their common end among them."""
        steps, press, drag = self.motion.steps, self.press_mm, self.drag_mm
        if press == 0 or drag == 0 or steps == 1:
            return np.linspace(0, press + drag, steps + 1)[1:]
        first = int(np.clip(round(steps * press / (press + drag)), 1, steps - 1))
        return np.concatenate(
            [np.linspace(0, press, first + 1)[1:], press + np.linspace(0, drag, steps - first + 1)[1:]]
        )

    def waypoints(self) -> FloatArray:
        """The records, and the end of the press where a single record would step over it."""
        return np.unique(np.concatenate([self.records(), [self.press_mm] if self.press_mm > 0 else []]))
