"""The indenter's load path: down, then sideways and round at once, then from pose to pose.

The path parameter is a length in mm: the distance that the farthest touching point moves, leg by leg.

Depth counts from the undeformed face below motion.position_mm: at 0 the indenter's lowest point is level with it (of a
mesh that point before its edges are rounded to what the gel resolves, see `synth.press.indenter.LOWERED`). On a
flat pad that is where it touches, and where the path starts. On a dome a body that comes down beside the apex meets the
gel toward the apex before that, and one whose lowest points are off its axis (a ring) touches later: there the path
starts where it first touches the sphere of which the face is a part. Sideways moves keep the level, whatever the face
does.

On a round gel all of this happens in the frame of the place (`PressFrame`): depth counts along the inward normal from
the tangent plane, and shear lies in that plane. A convex gel does not reach beyond it; where one from files does, as
where it is pressed along z beside its tip, the path starts level with its farthest point. A mesh's lowest point comes
down on the place, unless its offset_mm names another.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np

from synth.arrays import FloatArray
from synth.mesh.cad import CadFace
from synth.mesh.face import RoundFace, face_height
from synth.press.distance import KINDS
from synth.press.indenter import RigidBody, rotation_about
from synth.press.measure import Distance
from synth.scene import Motion
from synth.scene.motion import TWIST_ARM_MM

TOUCH_MM = 1e-6
"""The path starts so far off the gel, at most."""
OVER = 65
"""Places along each side of a flat gel or dome at which it is asked whether a body reaches into it."""


@dataclass(frozen=True)
class Pose:
    """The indenter at one point of its path: in the terms of the scene, and centre and axes in the sensor's frame."""

    depth_mm: float
    shear_mm: tuple[float, float]
    twist_deg: float
    centre: FloatArray
    rotation: FloatArray


@dataclass(frozen=True)
class PressFrame:
    """Where a round gel is pressed: the place (3,) mm on the face, and axes (3, 3) as columns.

    They are along increasing polar angle, along increasing azimuth, and along the inward normal; the gel begins
    `start_mm` along that, at most 0.
    """

    origin: FloatArray
    axes: FloatArray
    start_mm: float = 0.0

    @classmethod
    def of(cls, motion: Motion, face: RoundFace) -> "PressFrame":
        if isinstance(face, CadFace):
            return cls(*face.frame(motion))
        origin, inward = face.place(motion.polar_deg, motion.height_mm, motion.azimuth_deg)
        azimuth = np.radians(motion.azimuth_deg)
        around = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        return cls(origin, np.column_stack([np.cross(around, inward), around, inward]))


@dataclass(frozen=True)
class LoadPath:
    """The load path of one indenter over a pad whose face is flat or of the given radius, or over a round gel."""

    motion: Motion
    body: RigidBody
    dome_radius_mm: float | None = None
    frame: PressFrame | None = None

    @cached_property
    def face_mm(self) -> float:
        """Z of the undeformed face at motion.position_mm."""
        return float(face_height(np.array([self.motion.position_mm]), self.dome_radius_mm)[0])

    def is_over(self, size_mm: tuple[float, float, float]) -> bool:
        """Whether the body's middle is over the face of a gel and the body, being pressed in, reaches into it at all.

        The hole of a ring or an object, or the hollow between its feet, may be all that is over it. A needle goes
        through the face on its path. On a round gel the place alone is looked at: beside it the face recedes.
        """
        rim = float(self.body.shape[1]) if self.body.kind == KINDS["torus"] else 0.0
        if self.frame is not None:
            places = self.frame.origin[None]
        elif np.any(np.abs(self.motion.position_mm) + rim >= np.array(size_mm[:2]) / 2):
            return False
        else:
            x, y = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-s / 2, s / 2, OVER) for s in size_mm[:2])))
            places = np.column_stack([x, y, face_height(np.column_stack([x, y]), self.dome_radius_mm)])
        near = max(size_mm[:2]) / (OVER - 1)
        number = np.zeros(len(places), dtype=np.int32)
        for depth in np.linspace(self.press_mm, 0.0, 1 + math.ceil(max(self.press_mm, 0.0) / near)):
            pose = self.pose(float(depth))
            distance = Distance(self.body, pose.centre[None], pose.rotation[None])
            if distance(places, number)[1].min() < (near if self.frame is None else 0.0):
                return True
        return False

    @cached_property
    def touch_mm(self) -> float:
        """Depth at which the body first touches when it comes straight down; if the press ends before that, its depth.

        The body touches the sphere where the sphere's centre is a radius away from it: found by halving. For meshes,
        whose distance is approximate so far away, the depth at which they are level with the apex.
        """
        radius = self.dome_radius_mm
        if radius is None:
            return 0.0 if self.frame is None else self.frame.start_mm
        low, high = 0.0 - self.face_mm, max(self.motion.depth_mm, 0.0)
        if self.body.kind == KINDS["mesh"]:
            return low
        if self._off_mm(high, radius) >= 0:
            return high
        while high - low > TOUCH_MM:
            middle = (low + high) / 2
            low, high = (low, middle) if self._off_mm(middle, radius) < 0 else (middle, high)
        return low

    def _off_mm(self, depth: float, radius: float) -> float:
        """How far the body at a depth is from the dome's sphere."""
        place = np.array([[*self.motion.position_mm, self._level(depth)]])
        distance = Distance(self.body, place, self.body.rotation[None])
        return float(distance(np.array([[0.0, 0.0, radius]]), np.zeros(1, dtype=np.int32))[1][0]) - radius

    @property
    def direction(self) -> FloatArray:
        """(3,) of the press, into the gel."""
        return np.array([0.0, 0.0, 1.0]) if self.frame is None else self.frame.axes[:, 2]

    @property
    def depth_scale_mm(self) -> float:
        """The largest depth, at least 0.1 mm, by which penetrations are measured."""
        return max(float(self.corners[:, 0].max()), 0.1)

    @property
    def may_touch(self) -> bool:
        """Whether the body ever goes below the highest point of the undeformed gel, which on a dome is its apex."""
        highest = -self.face_mm if self.frame is None else self.frame.start_mm
        return bool(self.corners[:, 0].max() > highest)

    def _level(self, depth: float) -> float:
        """Z of the body's origin."""
        return depth + self.face_mm - self.body.reach_mm

    @cached_property
    def corners(self) -> FloatArray:
        """(k, 4) depth, shear x, shear y (mm) and twist (deg) at the start and at the end of each leg that moves."""
        motion = self.motion
        start = min(motion.depth_mm, self.touch_mm)
        poses = [(start, 0.0, 0.0, 0.0), (motion.depth_mm, 0.0, 0.0, 0.0)]
        poses += [(pose.depth_mm, *pose.shear_mm, pose.twist_deg) for pose in motion.stops.values()]
        return np.array([pose for pose, _ in groupby(poses)])

    @cached_property
    def ends(self) -> FloatArray:
        """(k,) path length at each of the corners."""
        step = np.diff(self.corners, axis=0)
        turned = np.radians(np.abs(step[:, 3])) * TWIST_ARM_MM
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(step[:, :3], axis=1) + turned)])

    @property
    def press_mm(self) -> float:
        """Length of the first leg, straight down."""
        return max(self.motion.depth_mm - self.touch_mm, 0.0)

    @property
    def length_mm(self) -> float:
        return float(self.ends[-1])

    def pose(self, s: float) -> Pose:
        """The indenter at path length s, 0 <= s <= length_mm."""
        depth, x, y, twist = (float(np.interp(s, self.ends, column)) for column in self.corners.T)
        motion = self.motion
        centre = np.array([motion.position_mm[0] + x, motion.position_mm[1] + y, self._level(depth)])
        rotation = rotation_about(2, np.radians(twist)) @ self.body.rotation
        if self.frame is not None:
            centre, rotation = self.frame.origin + self.frame.axes @ centre, self.frame.axes @ rotation
        return Pose(depth, (x, y), twist, centre, rotation)

    def records(self) -> FloatArray:
        """(steps,) path lengths at which states are recorded: each leg in equal parts, its end among them.

        Steps are dealt to the legs by their lengths, one at least to each; with fewer steps than legs, or where
        nothing moves, the whole path is cut in equal parts.
        """
        steps, lengths = self.motion.steps, np.diff(self.ends)
        if len(lengths) == 0 or steps < len(lengths):
            return np.linspace(0, self.length_mm, steps + 1)[1:]
        share = np.ones(len(lengths), dtype=int)
        while share.sum() < steps:  # the next step goes where they are longest
            share[np.argmax(lengths / share)] += 1
        parts = [np.linspace(a, b, n + 1)[1:] for a, b, n in zip(self.ends[:-1], self.ends[1:], share, strict=True)]
        return np.concatenate(parts)

    def recorded(self, state: int) -> Pose:
        """The indenter in a trajectory's state of that number, of which 0 is the undeformed one."""
        return self.pose(float(self.records()[state - 1]) if state else 0.0)

    def waypoints(self) -> FloatArray:
        """(k,) the records and the ends of the legs, where the path turns; rising, without the start."""
        stops = np.unique(np.concatenate([self.records(), self.ends]))
        return stops[stops > 0]

    def check(self) -> None:
        """InputError for a path that cannot be; what a motion says has been checked with the scene."""

    def turns_between(self, before: float, now: float) -> bool:
        """Whether the path turns after `before` and not after `now`, so that extrapolation across is meaningless."""
        return bool(np.any((self.ends > before) & (self.ends <= now)))
