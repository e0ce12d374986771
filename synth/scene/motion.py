"""The part of a scene's schema that is the indenter's motion."""

from itertools import pairwise
from math import dist
from typing import Annotated

from pydantic import Field, model_validator

from synth.scene.part import NonNegative, Part, Vector2
from synth.scene.pose_file import pose_problem

TWIST_ARM_MM = 3.0
"""Lever that turns an angle into a path length: about a contact's radius."""


class Pose(Part):
    """Where the indenter is, as Motion's own fields give the end of its press and shear."""

    depth_mm: NonNegative
    shear_mm: Vector2 = (0.0, 0.0)
    twist_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0


class Motion(Part):
    """Press at a place to depth_mm, then shear and twist together about the indenter's axis, then what follows.

    The place is position_mm on boxes and domes, which are pressed along z. Round gels are pressed along the inward
    normal at polar_deg, or height_mm, and azimuth_deg; there shear_mm lies in the tangent plane, its first component
    along increasing polar angle and its second along increasing azimuth, and a positive twist turns the first axis
    toward the second. At the tip, with azimuth 0, these are +x, +y and +z.

    Or the indenter goes from pose to pose, as a file says that stands alone: {poses = "grasp.csv"}.
    """

    depth_mm: float = 0.0
    """How far the indenter's lowest point goes past the undeformed surface; negative: how far it stays off."""
    shear_mm: Vector2 = (0.0, 0.0)
    twist_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Positive turns +x toward +y."""
    position_mm: Vector2 = (0.0, 0.0)
    polar_deg: Annotated[float, Field(ge=0, le=175)] | None = None
    """Angle at the centre of a capsule's hemisphere between the tip and the place; 0 is the tip."""
    height_mm: NonNegative | None = None
    """Z of the place, instead of polar_deg."""
    azimuth_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Azimuth of the place about the axis, from +x toward +y."""
    steps: Annotated[int, Field(ge=1, le=1000)] = 6
    """Recorded states after the undeformed one, split between the legs by the length of their paths."""
    then: tuple[Pose, ...] = ()
    """Poses to which the indenter moves next, one after another: a reversed shear, a release."""

    poses: tuple[tuple[float, float, float, float, float, float, float, float], ...] | None = None
    """Rows of a file of poses (`synth.scene.pose_file`), whose name stands here in a scene file. The first is that of
    the state at rest, and a state is recorded at each of the others."""

    @model_validator(mode="after")
    def _one_path(self) -> "Motion":
        if self.poses is None:
            if "depth_mm" not in self.model_fields_set:
                raise ValueError("depth_mm is missing; give it, or poses")
            return self
        if problem := pose_problem(self.poses):
            raise ValueError(f"poses[{problem[0]}]: {problem[1]}")
        fields = type(self).model_fields
        if other := [n for n in fields if n not in ("poses", "steps") and getattr(self, n) != fields[n].default]:
            raise ValueError(
                f"poses say all of the path: leave out {', '.join(other)}, or give motion = {{ poses = ... }}"
            )
        if self.steps != len(self.poses) - 1:
            raise ValueError(f"steps = {self.steps}: {len(self.poses)} poses have {len(self.poses) - 1}; leave it out")
        return self

    @property
    def length_mm(self) -> float:
        """How far the indenter goes, roughly: down and sideways, or from pose to pose; 0 where it does not press."""
        if self.poses is not None:
            return sum(dist(a[1:4], b[1:4]) for a, b in pairwise(self.poses))
        drag = abs(self.shear_mm[0]) + abs(self.shear_mm[1]) + abs(self.twist_deg) * 0.01745 * TWIST_ARM_MM
        return self.depth_mm + drag if self.depth_mm > 0 or self.then else 0.0

    @property
    def stops(self) -> dict[str, "Motion | Pose"]:
        """The end of press and shear, and each pose after it, by its name in a scene file."""
        return {"motion": self, **{f"motion.then[{i}]": pose for i, pose in enumerate(self.then)}}

    @property
    def moves(self) -> int:
        """Legs of the load path: press, shear with twist, and one to each pose that differs from the one before."""
        stops = [(min(self.depth_mm, 0.0), (0.0, 0.0), 0.0), (self.depth_mm, (0.0, 0.0), 0.0)]
        stops += [(pose.depth_mm, pose.shear_mm, pose.twist_deg) for pose in self.stops.values()]
        return sum(start != end for start, end in pairwise(stops))
