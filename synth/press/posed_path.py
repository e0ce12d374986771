"""The load path of an indenter whose poses are given, such as a robot's or a simulator's log of a grasp.

Between two poses its origin moves straight, and it turns about a fixed axis, both evenly. As for other load paths
(`synth.press.load_path`) the path parameter is a length in mm: how far the point of the body moves that is over the
gel, near its origin, and what the body's turn moves points beside it, leg by leg.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.mesh.face import face_height
from synth.press.indenter import Touchable
from synth.press.load_path import OVER, TOUCH_MM, LoadPath, Pose
from synth.press.measure import Distance
from synth.scene import Gel, Motion, RoundGel, Vector3
from synth.scene.motion import TWIST_ARM_MM

PAUSE_MM = 1e-6
"""Length of a leg on which nothing moves, so that its end has a place of its own."""
TURN = 0.5
"""The path turns where its direction, per length, changes by more: extrapolation across such a pose is meaningless."""
DEEPEST = 0.85
"""Share of the gel's thickness that no pose may go beyond, as in `synth.scene.Scene`."""
ROUND_SHARE = 0.1
"""Penetrations on a round gel are measured by this share of its thickness: the depth of a pose says nothing there."""
IN_GEL = "in the gel in its first pose, in which the gel is at rest"
NEAR_MM = 1.0
"""What an object may touch is known to such a distance around the gel at rest."""


@dataclass(frozen=True)
class PosedPath(LoadPath):
    """The load path of one indenter through the poses of a motion, over a gel."""

    gel: Gel = field(kw_only=True)

    @cached_property
    def _poses(self) -> tuple[FloatArray, FloatArray]:
        return poses_of(self.motion)

    @cached_property
    def _moving(self) -> FloatArray:
        """(k - 1, 6): in each leg the motion of the body's point over the gel, mm, and the rotation vector, rad."""
        (places, turns), half = self._poses, np.array([*self.gel.size_mm[:2], 0.0]) / 2
        turn, before = turns[1:] @ turns[:-1].transpose(0, 2, 1), np.clip(places[:-1], -half, half)
        after = places[1:] + np.einsum("kij,kj->ki", turn, before - places[:-1])
        return np.column_stack([after - before, Rotation.from_matrix(turn).as_rotvec()])

    @cached_property
    def ends(self) -> FloatArray:
        """(k,) path length at each pose."""
        length = np.linalg.norm(self._moving[:, :3], axis=1)
        length += TWIST_ARM_MM * np.linalg.norm(self._moving[:, 3:], axis=1)
        return np.concatenate([[0.0], np.cumsum(np.maximum(length, PAUSE_MM))])

    def turns_between(self, before: float, now: float) -> bool:
        along = self._moving * ([1.0] * 3 + [TWIST_ARM_MM] * 3) / np.diff(self.ends)[:, None]
        turns = self.ends[1:-1][np.linalg.norm(np.diff(along, axis=0), axis=1) > TURN]
        return bool(np.any((turns > before) & (turns <= now)))

    press_mm = 0.0
    """There is no leg of a press."""
    may_touch = True

    @cached_property
    def depth_scale_mm(self) -> float:
        return ROUND_SHARE * self.gel.depth_mm if isinstance(self.gel, RoundGel) else max(self.as_press().depth_mm, 0.1)

    def pose(self, s: float) -> Pose:
        """The indenter at path length s, 0 <= s <= length_mm.

        Depth is that of its lowest point below z = 0, shear the way of its origin since the first pose, and twist the
        turn about z that is nearest to its turn since then.
        """
        places, turns = self._poses
        leg = int(np.clip(np.searchsorted(self.ends, s, side="right") - 1, 0, len(self.ends) - 2))
        share = (s - self.ends[leg]) / (self.ends[leg + 1] - self.ends[leg])
        centre = (1 - share) * places[leg] + share * places[leg + 1]
        turn = Rotation.from_rotvec(share * self._moving[leg, 3:]).as_matrix() @ turns[leg]
        since = turn @ turns[0].T
        twist = float(np.degrees(np.arctan2(since[1, 0] - since[0, 1], since[0, 0] + since[1, 1])))
        x, y, _ = map(float, centre - places[0])
        rotation = turn @ self.body.rotation
        return Pose(float(centre[2]) + self.body.reach_along(rotation[2]), (x, y), twist, centre, rotation)

    def records(self) -> FloatArray:
        return self.ends[1:]

    def as_press(self) -> Motion:
        """A press as deep that is dragged as far: what error and time are predicted from."""
        poses = [self.pose(float(end)) for end in self.ends]
        x, y = np.ptp([pose.shear_mm for pose in poses if pose.depth_mm > 0] or [(0.0, 0.0)], axis=0)
        return Motion(depth_mm=max(pose.depth_mm for pose in poses), shear_mm=(float(x), float(y)))

    def check(self) -> None:
        """InputError, with the line of the file, for a pose that cannot be; of round gels nothing is asked here."""
        if isinstance(self.gel, RoundGel):
            return
        x, y = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-s / 2, s / 2, OVER) for s in self.gel.size_mm[:2])))
        face, deepest = face_height(np.column_stack([x, y]), self.dome_radius_mm), DEEPEST * self.gel.depth_mm
        for line, end in enumerate(self.ends, 2):
            pose = self.pose(float(end))
            distance = Distance(self.body, pose.centre[None], pose.rotation[None])
            looked_at = np.column_stack([x, y, face if line == 2 else np.full(len(x), deepest)])
            if distance(looked_at, np.zeros(len(x), dtype=np.int32))[1].min() < -TOUCH_MM:
                wrong = (
                    IN_GEL if line == 2 else f"at least {deepest:.3g} mm, 85 % of the gel's thickness, deep in the gel"
                )
                raise InputError(f"motion.poses, line {line}: the object is {wrong}; places are in mm")


def poses_of(motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Places (k, 3) mm of the body's origin, and turns (k, 3, 3) of its frame, in a motion by poses."""
    rows = np.array(motion.poses)
    return rows[:, 1:4], np.asarray(Rotation.from_quat(rows[:, 4:]).as_matrix())


def touchable_at(motion: Motion, size_mm: Vector3) -> Touchable:
    """The part of a body that comes near a gel, whose bounding box is of that size, at any of a motion's poses."""
    x, y, z = size_mm
    corners = np.array([[i * x / 2, j * y / 2, k] for i in (-1, 1) for j in (-1, 1) for k in (-z, z)])
    places, turns = poses_of(motion)
    every = ((corners - places[:, None]) @ turns).reshape(-1, 3)
    return Touchable(box=np.array([every.min(axis=0) - NEAR_MM, every.max(axis=0) + NEAR_MM]))
