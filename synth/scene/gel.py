"""The part of a scene's schema that is the gel: its size, the shape of its contact face, its materials."""

import math
from typing import Annotated, Literal, TypeVar

from pydantic import Field, model_validator

from synth.arrays import FloatArray
from synth.scene.part import NonNegative, Part, Positive, Vector3

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
_NEEDED = {
    "box": ("size_mm",),
    "dome": ("size_mm",),
    "capsule": ("radius_mm", "thickness_mm"),
    "file": ("outer", "window", "unit"),
}

Number = TypeVar("Number", float, FloatArray)


def dome_height(square_mm2: Number, radius_mm: float) -> Number:
    """R - sqrt(R² - r²), mm, without its cancellation: z of a dome's face at squared distances r² from the axis."""
    return square_mm2 / (radius_mm + (radius_mm**2 - square_mm2) ** 0.5)


class Layer(Part):
    """A layer of another material on the pad's contact side, such as a stiff coating film."""

    thickness_mm: Annotated[float, Field(ge=0.02, le=20)]
    youngs_modulus_kpa: Annotated[float, Field(ge=0.1, le=1e6)]
    poisson_ratio: Annotated[float, Field(ge=0.3, le=0.5)] = 0.4999
    stiffening: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """As `Gel.stiffening`."""


class Gel(Part):
    """The soft gel on its rigid window.

    A "box" is bonded on its +z side; so is a "dome", whose contact face is part of a sphere. A "capsule" is a layer
    around a window of the same shape: a hemisphere about (0, 0, radius_mm), then a cylinder up to z = radius_mm +
    length_mm, where it is cut. A "file" gel is what lies inside `outer` and outside `window`, to which it is bonded.
    """

    size_mm: tuple[
        Annotated[float, Field(ge=1, le=LARGEST_MM)],
        Annotated[float, Field(ge=1, le=LARGEST_MM)],
        Annotated[float, Field(ge=0.2, le=LARGEST_MM)],
    ] = (0.0, 0.0, 0.0)
    """The third is the thickness, of a domed pad that at the apex. Follows from the shape of round gels."""
    shape: Literal["box", "dome", "capsule", "file"] = "box"
    dome_radius_mm: Positive | None = None
    """Radius of a dome's contact face, which touches z = 0 at its apex (0, 0) and curves away from the indenter; None:
    flat. Patterns are laid on it along z: their places are x and y."""
    radius_mm: Annotated[float, Field(ge=1, le=100)] | None = None
    """Radius of a capsule's contact face."""
    thickness_mm: Annotated[float, Field(ge=0.2, le=THICKEST_MM)] | None = None
    """Thickness of a capsule's layer of gel; of a gel from files that on the axis, which follows from them."""
    length_mm: Annotated[float, Field(ge=0, le=LARGEST_MM)] = 0.0
    """Length of a capsule's cylinder; 0: a hemisphere."""
    cut_end: Literal["free", "held"] = "free"
    """Whether the plane of largest z, in which a round gel ends, is held, as by a rigid frame."""
    outer: str | None = None
    """File of a closed surface, whose bounding box is moved to z = 0 and to the middle in x and y; +z points from the
    face to the camera, y is mirrored. It is coated from its point on the axis up to the first sharp edges."""
    window: str | None = None
    """File of the closed surface that the gel is bonded to, in the same axes; optics are those of [sensor.window]."""
    unit: Literal["mm", "cm", "m", "inch"] | None = None
    """Unit of lengths in the files."""
    rotation_deg: Vector3 = (0.0, 0.0, 0.0)
    """Turns both files' bodies about the files' x, then y, then z axis, right-handed, before they are placed."""
    digest: str = ""
    """Digest of the files' content and their rotation; filled in when a scene is loaded."""
    youngs_modulus_kpa: Annotated[float, Field(ge=0.1, le=1e6)]
    poisson_ratio: Annotated[float, Field(ge=0, le=0.5)] = 0.4999
    """0.5 is exactly incompressible; below 0.3 no pressure field is needed."""
    stiffening: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Yeoh's C20/C10 and C30/C10 (Rubber Chem. Technol. 66, 1993); zeros: neo-Hookean."""
    layers: tuple[Layer, ...] = ()
    """Layers from the contact face inward; what is left of the thickness is the gel's own material. Under a dome their
    thicknesses are those at the apex; elsewhere they shrink with the pad's. In round gels they are depths below the
    coated face."""

    def face_mm(self, x: float, y: float) -> float:
        """Z of the undeformed contact face, mm; the gel's upper end where a sphere does not reach."""
        radius, square = self.radius_mm or self.dome_radius_mm, x * x + y * y
        if radius is None:
            return 0.0
        return float(dome_height(square, radius)) if square < radius**2 else self.size_mm[2]

    @property
    def is_round(self) -> bool:
        """Whether a press may have its place in polar coordinates; the mesh is then always one of fTetWild's."""
        return self.shape in ("capsule", "file")

    @property
    def is_flat(self) -> bool:
        """Whether the contact face lies in z = 0."""
        return self.shape == "box"

    @property
    def depth_mm(self) -> float:
        """Thickness of the gel, of a domed pad that at the apex."""
        return self.thickness_mm or self.size_mm[2]

    @property
    def layers_mm(self) -> tuple[float, ...]:
        return tuple(layer.thickness_mm for layer in self.layers)

    @model_validator(mode="after")
    def _shaped(self) -> "Gel":
        needed = _NEEDED[self.shape]
        if any(name not in self.model_fields_set or getattr(self, name) is None for name in needed):
            raise ValueError(f'shape = "{self.shape}" needs {" and ".join(needed)}')
        for shape, names in _NEEDED.items():
            follows = ("size_mm", "thickness_mm") if self.is_round else ("size_mm",)
            for name in names:
                if name not in (*needed, *follows) and getattr(self, name) is not None:
                    raise ValueError(f'{name} belongs to shape = "{shape}", the shape is "{self.shape}"')
        if not self.is_round and self.size_mm[2] > THICKEST_MM:
            raise ValueError(
                f"size_mm[2] = {self.size_mm[2]} is a pad's thickness, at most {THICKEST_MM:g} mm: check its unit"
            )
        if self.length_mm and self.shape != "capsule":
            raise ValueError(f'length_mm belongs to shape = "capsule", the shape is "{self.shape}"')
        if any(self.rotation_deg) and self.shape != "file":
            raise ValueError(f'rotation_deg belongs to shape = "file", the shape is "{self.shape}"')
        if self.cut_end != "free" and not self.is_round:
            raise ValueError(f'cut_end is for round gels, the shape is "{self.shape}"')
        if self.shape == "file" and "size_mm" not in self.model_fields_set:
            raise ValueError("outer and window must each name one file, which load_scene measures")
        if self.shape != "capsule" or self.radius_mm is None or self.thickness_mm is None:
            return self
        if self.thickness_mm > THICKEST * self.radius_mm:
            raise ValueError(
                f"thickness_mm = {self.thickness_mm} leaves no room for a window in radius_mm = {self.radius_mm}: at "
                f"most {THICKEST * self.radius_mm:.4g}"
            )
        bounds = (2 * self.radius_mm, 2 * self.radius_mm, self.radius_mm + self.length_mm)
        if "size_mm" in self.model_fields_set and self.size_mm != bounds:
            raise ValueError("size_mm of a capsule follows from radius_mm and length_mm: leave it out")
        object.__setattr__(self, "size_mm", bounds)
        return self

    @model_validator(mode="after")
    def _layered(self) -> "Gel":
        covered = sum(self.layers_mm)
        if covered >= self.depth_mm:
            raise ValueError(
                f"layers are {covered:.4g} mm thick together and leave nothing of the gel's {self.depth_mm} mm"
            )
        if self.layers and self.poisson_ratio < 0.3:
            raise ValueError(f"poisson_ratio = {self.poisson_ratio}: a layered pad needs at least 0.3")
        return self

    @model_validator(mode="after")
    def _domed(self) -> "Gel":
        if (self.shape == "dome") != (self.dome_radius_mm is not None):
            raise ValueError('shape = "dome" and dome_radius_mm belong together: give both, or neither for a flat face')
        if self.dome_radius_mm is None:
            return self
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
