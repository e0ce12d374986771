"""Where the indenter is along its way: down, then sideways and round at once, then from pose to pose.

The path parameter is a length in mm: the distance that the farthest touching point moves, leg by leg.
"""

from dataclasses import dataclass
from functools import cached_property

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

    @cached_property
    def corners(self) -> FloatArray:
        """(k, 4) depth, shear x, shear y (mm) and twist (deg) at the start and at the end of each leg that moves."""
        motion = self.motion
        start = min(motion.depth_mm, 0.0)
        poses = [(start, 0.0, 0.0, 0.0), (motion.depth_mm, 0.0, 0.0, 0.0)]
        poses.append((motion.depth_mm, *motion.shear_mm, motion.twist_deg))
        poses += [(pose.depth_mm, *pose.shear_mm, pose.twist_deg) for pose in motion.then]
        kept = [poses[0]]
        for pose in poses[1:]:
            if pose != kept[-1]:
                kept.append(pose)
        return np.array(kept)

    @cached_property
    def ends(self) -> FloatArray:
        """(k,) path length at each of the corners."""
        step = np.diff(self.corners, axis=0)
        turned = np.radians(np.abs(step[:, 3])) * TWIST_ARM_MM
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(step[:, :3], axis=1) + turned)])

    @property
    def press_mm(self) -> float:
        """Length of the first leg, straight down."""
        return max(self.motion.depth_mm, 0.0)

    @property
    def length_mm(self) -> float:
        """Of the whole way."""
        return float(self.ends[-1])

    def pose(self, s: float) -> Pose:
        """The indenter at path length s, 0 <= s <= length_mm."""
        depth, x, y, twist = (float(np.interp(s, self.ends, column)) for column in self.corners.T)
        motion = self.motion
        centre = np.array([motion.position_mm[0] + x, motion.position_mm[1] + y, depth - self.body.reach_mm])
        return Pose(depth, (x, y), twist, centre, rotation_about(2, np.radians(twist)) @ self.body.rotation)

    def records(self) -> FloatArray:
        """(steps,) path lengths at which states are recorded: each leg in equal parts, its end among them.

        Steps are dealt to the legs by their lengths, one at least to each; with fewer steps than legs, or where
        nothing moves, the whole way is cut in equal parts.
        """
        steps, lengths = self.motion.steps, np.diff(self.ends)
        if len(lengths) == 0 or steps < len(lengths):
            return np.linspace(0, self.length_mm, steps + 1)[1:]
        share = np.ones(len(lengths), dtype=int)
        while share.sum() < steps:  # the next step goes where they are longest
            share[np.argmax(lengths / share)] += 1
        parts = [np.linspace(a, b, n + 1)[1:] for a, b, n in zip(self.ends[:-1], self.ends[1:], share, strict=True)]
        return np.concatenate(parts)

    def waypoints(self) -> FloatArray:
        """(k,) the records and the ends of the legs, where the way turns; rising, without the start."""
        stops = np.unique(np.concatenate([self.records(), self.ends]))
        return stops[stops > 0]

    def turns_between(self, before: float, now: float) -> bool:
        """Whether the way turns after `before` and not after `now`, so that extrapolation across is meaningless."""
        return bool(np.any((self.ends > before) & (self.ends <= now)))
