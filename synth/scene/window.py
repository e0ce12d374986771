"""The part of a scene's schema that is the window: a union of the shapes of its face toward the camera.

Light bends at that face: a plane beyond the gel, or a round face about the z axis that encloses the camera in air. A
plane reflects light back onto the gel (but not in scalar variants), a round face does not.
"""

import math
from abc import abstractmethod
from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from synth.scene.part import Part, Positive, Vector3, shape_or


class BaseWindow(Part):
    """Base of the windows: rigid clear supports between gel and camera, index-matched to the gel."""

    refractive_index: Annotated[float, Field(ge=1, le=2.5)] = 1.45
    """1: matched to the camera's side, too; nothing bends."""
    thickness_mm: Annotated[float, Field(ge=0, le=100)] = 5.0


class PlaneWindow(BaseWindow):
    """Plate."""

    shape: Literal["plane"] = "plane"


class CurvedWindow(BaseWindow):
    """Base of the windows whose face is all points that are radius_mm away from a part of the z axis."""

    radius_mm: Positive

    @property
    @abstractmethod
    def axis_mm(self) -> tuple[float, float]:
        """Ends of that part of the axis."""

    def clearance_mm(self, point: Vector3) -> float:
        """How far a point lies inside the face; negative outside."""
        x, y, z = point
        low, high = self.axis_mm
        return self.radius_mm - math.hypot(x, y, z - min(max(z, low), high))


class SphereWindow(CurvedWindow):
    """Ball of air."""

    shape: Literal["sphere"]
    center_z_mm: float

    @property
    def axis_mm(self) -> tuple[float, float]:
        return self.center_z_mm, self.center_z_mm


class CylinderWindow(CurvedWindow):
    """Tube about the axis."""

    shape: Literal["cylinder"]

    @property
    def axis_mm(self) -> tuple[float, float]:
        return -math.inf, math.inf


class CapsuleWindow(CurvedWindow):
    """Hemisphere toward the tip and a cylinder above it."""

    shape: Literal["capsule"]
    center_z_mm: float
    """Z of the hemisphere's centre."""

    @property
    def axis_mm(self) -> tuple[float, float]:
        return self.center_z_mm, math.inf


Window = Annotated[
    Annotated[PlaneWindow, Tag("plane")]
    | Annotated[SphereWindow, Tag("sphere")]
    | Annotated[CylinderWindow, Tag("cylinder")]
    | Annotated[CapsuleWindow, Tag("capsule")],
    Discriminator(shape_or("plane")),
]
