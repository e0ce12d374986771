"""The part of a scene's schema that is the gel: a union of shapes, with what they share.

A pad is pressed along z at position_mm and bonded to its window on its +z side. A round gel is a layer around its
window, and a press may have its place in polar coordinates; its mesh is always one of fTetWild's.
"""

import math
from abc import abstractmethod
from typing import Annotated, ClassVar, Literal, TypeVar

from pydantic import Discriminator, Field, Tag, model_validator

from synth.arrays import FloatArray
from synth.scene.motion import Motion
from synth.scene.part import NonNegative, Part, Positive, Vector3, shape_or

THINNEST = 0.3
"""A domed pad keeps at least this share of its thickness at the corners. Elements there are flattened to that share of
their height at the apex, see `synth.mesh.dome` for what becomes of their quality."""
STEEPEST_DEG = 60.0
"""Largest slope of a dome's face, at its corners."""
LARGEST_MM = 400.0
"""Longest side of a gel, as of a robot's arm that is covered in one; beyond, a wrong unit is more likely."""
THICKEST_MM = 50.0
"""Largest thickness of a layer of gel, alike."""
THICKEST = 0.9
"""Largest share of a capsule's radius that its layer of gel takes."""

_Side = Annotated[float, Field(ge=1, le=LARGEST_MM)]
_Thickness = Annotated[float, Field(ge=0.2, le=THICKEST_MM)]
Number = TypeVar("Number", float, FloatArray)


def dome_height(square_mm2: Number, radius_mm: float) -> Number:
    """R - sqrt(R² - r²), mm, without its cancellation: z of a dome's face at squared distances r² from the axis."""
    return square_mm2 / (radius_mm + (radius_mm**2 - square_mm2) ** 0.5)


class Layer(Part):
    """A layer of another material on the gel's contact side, such as a stiff coating film."""

    thickness_mm: Annotated[float, Field(ge=0.02, le=20)]
    youngs_modulus_kpa: Annotated[float, Field(ge=0.1, le=1e6)]
    poisson_ratio: Annotated[float, Field(ge=0.3, le=0.5)] = 0.4999
    stiffening: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """As `BaseGel.stiffening`."""


class BaseGel(Part):
    """Base of the gels: soft material on a rigid window."""

    youngs_modulus_kpa: Annotated[float, Field(ge=0.1, le=1e6)]
    poisson_ratio: Annotated[float, Field(ge=0, le=0.5)] = 0.4999
    """0.5 is exactly incompressible; below 0.3 no pressure field is needed."""
    stiffening: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Yeoh's C20/C10 and C30/C10 (Rubber Chem. Technol. 66, 1993); zeros: neo-Hookean."""
    layers: tuple[Layer, ...] = ()
    """Layers from the contact face inward; what is left of the thickness is the gel's own material. Under a dome their
    thicknesses are those at the apex; elsewhere they shrink with the pad's. In round gels they are depths below the
    coated face."""
    placings: ClassVar[tuple[str, ...]]
    """How a pattern may be laid on the face, see `synth.scene.pattern`."""

    @property
    @abstractmethod
    def depth_mm(self) -> float:
        """Thickness of the gel, of a domed pad that at the apex."""

    @property
    def layers_mm(self) -> tuple[float, ...]:
        return tuple(layer.thickness_mm for layer in self.layers)

    @model_validator(mode="after")
    def _layered(self) -> "BaseGel":
        covered = sum(self.layers_mm)
        if covered >= self.depth_mm:
            raise ValueError(
                f"layers are {covered:.4g} mm thick together and leave nothing of the gel's {self.depth_mm} mm"
            )
        if self.layers and self.poisson_ratio < 0.3:
            raise ValueError(f"poisson_ratio = {self.poisson_ratio}: a layered pad needs at least 0.3")
        return self


class PadGel(BaseGel):
    """Base of the gels with straight sides."""

    size_mm: tuple[_Side, _Side, _Thickness]
    """The third is the thickness, of a domed pad that at the apex."""
    placings: ClassVar[tuple[str, ...]] = ("z",)

    @property
    def depth_mm(self) -> float:
        return self.size_mm[2]

    def check_place(self, motion: Motion) -> None:
        """Refuse, by ValueError, a place of a press that is not in the terms of the gel's shape, or not on its face."""
        if motion.polar_deg is not None or motion.height_mm is not None or motion.azimuth_deg != 0:
            raise ValueError(
                "motion.polar_deg, height_mm and azimuth_deg are for round gels; this one has motion.position_mm"
            )


class BoxGel(PadGel):
    """Pad with a flat contact face in z = 0."""

    shape: Literal["box"] = "box"
    dome_radius_mm: ClassVar[None] = None

    def face_mm(self, x: float, y: float) -> float:
        """Z of the undeformed contact face, mm; the gel's upper end where a sphere does not reach."""
        return 0.0


class DomeGel(PadGel):
    """Pad whose contact face is part of a sphere that touches z = 0 at its apex and curves away from the indenter.

    Patterns are laid on it along z: their places are x and y.
    """

    shape: Literal["dome"]
    dome_radius_mm: Positive

    def face_mm(self, x: float, y: float) -> float:
        return _sphere_mm(x, y, self.dome_radius_mm, self.size_mm[2])

    @model_validator(mode="after")
    def _reaches_the_corners(self) -> "DomeGel":
        x, y, thickness = self.size_mm
        corner = math.hypot(x, y) / 2
        # The sphere that comes down so far at the corners, or that is so steep there, whichever is the larger.
        deepest = min((1 - THINNEST) * thickness, corner * math.tan(math.radians(STEEPEST_DEG / 2)))
        least = (corner**2 + deepest**2) / (2 * deepest)
        if self.dome_radius_mm < least:
            raise ValueError(
                f"dome_radius_mm = {self.dome_radius_mm} curves too much for a pad of size_mm = {list(self.size_mm)}: "
                f"at its corners, {corner:.4g} mm from the apex, {100 * THINNEST:.0f} % of the thickness must be left "
                f"and the face must slope by less than {STEEPEST_DEG:.0f} degrees; use at least {least:.4g} mm, or a "
                "smaller or thicker pad"
            )
        return self


class RoundGel(BaseGel):
    """Base of the gels around their window."""

    thickness_mm: float
    cut_end: Literal["free", "held"] = "free"
    """Whether the plane of largest z, in which the gel ends, is held, as by a rigid frame."""
    dome_radius_mm: ClassVar[None] = None
    placings: ClassVar[tuple[str, ...]] = ("z", "spherical", "cylindrical")

    @property
    def depth_mm(self) -> float:
        return self.thickness_mm


class CapsuleGel(RoundGel):
    """Layer around a window of the same shape.

    A hemisphere about (0, 0, radius_mm), then a cylinder up to z = radius_mm + length_mm, where it is cut.
    """

    shape: Literal["capsule"]
    radius_mm: Annotated[float, Field(ge=1, le=100)]
    """Radius of the contact face."""
    thickness_mm: _Thickness
    length_mm: Annotated[float, Field(ge=0, le=LARGEST_MM)] = 0.0
    """Length of the cylinder; 0: a hemisphere."""

    @property
    def size_mm(self) -> Vector3:
        """Edge lengths of the bounding box."""
        return 2 * self.radius_mm, 2 * self.radius_mm, self.radius_mm + self.length_mm

    def face_mm(self, x: float, y: float) -> float:
        return _sphere_mm(x, y, self.radius_mm, self.size_mm[2])

    def check_place(self, motion: Motion) -> None:
        if motion.position_mm != (0.0, 0.0):
            raise ValueError("motion.position_mm is for flat gels and domes; a round gel has polar_deg and azimuth_deg")
        _check_end(motion, self.size_mm)

    @model_validator(mode="after")
    def _has_room(self) -> "CapsuleGel":
        if self.thickness_mm > THICKEST * self.radius_mm:
            raise ValueError(
                f"thickness_mm = {self.thickness_mm} leaves no room for a window in radius_mm = {self.radius_mm}: at "
                f"most {THICKEST * self.radius_mm:.4g}"
            )
        return self


class FileGel(RoundGel):
    """What lies inside `outer` and outside `window`, to which it is bonded.

    What follows from the files (size_mm, thickness_mm, digest) is filled in when a scene is loaded, see
    `synth.scene.gel_file`, so that a dataset can be read where they are not.
    """

    shape: Literal["file"]
    outer: str
    """File of a closed surface, whose bounding box is moved to z = 0 and to the middle in x and y; +z points from the
    face to the camera, y is mirrored. It is coated from its point on the axis up to the first sharp edges."""
    window: str
    """File of the closed surface that the gel is bonded to, in the same axes; optics are those of [sensor.window]."""
    unit: Literal["mm", "cm", "m", "inch"]
    """Unit of lengths in the files."""
    rotation_deg: Vector3 = (0.0, 0.0, 0.0)
    """Turns both files' bodies about the files' x, then y, then z axis, right-handed, before they are placed."""
    size_mm: tuple[_Side, _Side, Annotated[float, Field(ge=0.2, le=LARGEST_MM)]] = (0.0, 0.0, 0.0)
    """Edge lengths of the bounding box."""
    thickness_mm: _Thickness = math.inf
    """Thickness on the axis."""
    digest: str = ""
    """Digest of the files' content and their rotation."""
    placings: ClassVar[tuple[str, ...]] = (*RoundGel.placings, "uv")

    def face_mm(self, x: float, y: float) -> float:
        return 0.0

    def check_place(self, motion: Motion) -> None:
        if motion.polar_deg is None and motion.height_mm is None and motion.azimuth_deg != 0:
            raise ValueError("motion.azimuth_deg goes with polar_deg or height_mm; without, the press is along z")
        _check_end(motion, self.size_mm)

    @model_validator(mode="after")
    def _read(self) -> "FileGel":
        if "size_mm" not in self.model_fields_set:
            raise ValueError("outer and window must each name one file, which load_scene measures")
        return self


Gel = Annotated[
    Annotated[BoxGel, Tag("box")]
    | Annotated[DomeGel, Tag("dome")]
    | Annotated[CapsuleGel, Tag("capsule")]
    | Annotated[FileGel, Tag("file")],
    Discriminator(shape_or("box")),
]


def _sphere_mm(x: float, y: float, radius_mm: float, top_mm: float) -> float:
    """Z of a face that is a sphere at its lowest point; the gel's upper end where the sphere does not reach."""
    square = x * x + y * y
    return float(dome_height(square, radius_mm)) if square < radius_mm**2 else top_mm


def _check_end(motion: Motion, size_mm: Vector3) -> None:
    """Refuse a place of a press that is said twice, or is beyond a round gel's end."""
    polar, height = motion.polar_deg, motion.height_mm
    if polar is not None and height is not None:
        raise ValueError("motion.polar_deg and height_mm both say where the press is: give one of them")
    radius, top = size_mm[0] / 2, size_mm[2]
    highest = 90 + math.degrees(math.atan2(top - radius, radius))
    if polar is not None and polar > highest:
        raise ValueError(f"motion.polar_deg = {polar} is beyond the gel's end; at most {highest:.4g}")
    if height is not None and height > top:
        raise ValueError(f"motion.height_mm = {height} is beyond the gel's end; at most {top:.4g}")
