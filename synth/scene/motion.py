"""The part of a scene's schema that is the indenter's motion."""

from itertools import pairwise
from typing import Annotated

from pydantic import Field

from synth.scene.part import NonNegative, Part, Vector2


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
    """

    depth_mm: float
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

    @property
    def poses(self) -> dict[str, "Motion | Pose"]:
        """The end of press and shear, and each pose after it, by its name in a scene file."""
        return {"motion": self, **{f"motion.then[{i}]": pose for i, pose in enumerate(self.then)}}

    @property
    def moves(self) -> int:
        """Legs of the load path: press, shear with twist, and one to each pose that differs from the one before."""
        stops = [(min(self.depth_mm, 0.0), (0.0, 0.0), 0.0), (self.depth_mm, (0.0, 0.0), 0.0)]
        stops += [(pose.depth_mm, pose.shear_mm, pose.twist_deg) for pose in self.poses.values()]
        return sum(start != end for start, end in pairwise(stops))
