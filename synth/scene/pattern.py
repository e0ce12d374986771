"""The part of a scene's schema that is the pattern on the contact face.

A pattern lies in material coordinates: it is printed on the undeformed face and moves with it. Positions are those of
the scene's frame, x right and y down in the image, with the origin at the pad's middle.
"""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from synth.scene.part import Color, Fraction, NonNegative, Part, Positive, Vector2


class NoPattern(Part):
    """Bare coating."""

    kind: Literal["none"]


MarkLayer = Literal["in_coating", "above_coating"]
"""Where marks lie. in_coating: they change the coating's reflectance and share its roughness and metallic.
above_coating: they are matt paint on the camera's side of the coating and take no part in its shine, as where markers
are printed on the gel and the coating is laid over them (GelSight: Yuan et al., Sensors 17(12):2762, 2017, figures 3
and 4). The paint has no thickness: it moves with the coating, and the flow is that of the coating."""

Placing = Literal["z", "spherical", "cylindrical"]
"""How marks are laid on the face. z: along z, so that where it slopes they are longer. The others are for round gels,
rows along meridians about the axis, and there marks have their true sizes in mm on the face: spherical counts the
spacing along the meridian from the tip, cylindrical counts it along z; grains are the same in both."""


class Dots(Part):
    """Printed dots on a grid whose first dot lies offset_mm from the pad's centre.

    On a round gel the first number of spacing_mm is the distance between meridians, and of offset_mm the first one's
    from azimuth 0, at the gel's largest radius; toward the tip meridians meet. A whole number of them is made. The
    second numbers are along the meridian, or along z, from the tip.
    """

    kind: Literal["dots"]
    spacing_mm: tuple[Positive, Positive]
    radius_mm: Positive
    """Radius of a round dot; distance from the middle to the corners of a diamond."""
    shape: Literal["round", "diamond"] = "round"
    """diamond: a square whose corners point along the grid. With a radius of half the spacing neighbours touch and make
    a checkerboard, the continuous marker pattern of arXiv:2305.11782."""
    offset_mm: Vector2 = (0.0, 0.0)
    rotation_deg: Annotated[float, Field(ge=-90, le=90)] = 0.0
    """Turns the grid about its first dot; positive turns +x toward +y."""
    jitter_mm: NonNegative = 0.0
    """Standard deviation of each dot's centre around the grid, along x and along y."""
    radius_jitter: Fraction = 0.0
    """Relative standard deviation of each dot's radius."""
    softness_mm: NonNegative = 0.02
    """Width of the dot's edge."""
    reflectance: Color = (0.03, 0.03, 0.03)
    layer: MarkLayer = "in_coating"
    placing: Placing = "z"

    @model_validator(mode="after")
    def _leaves_coating(self) -> "Dots":
        if self.placing != "z" and self.rotation_deg:
            raise ValueError(f"rotation_deg = {self.rotation_deg}: rows of dots along meridians cannot be turned")
        across, down = self.spacing_mm
        most = math.hypot(across, down) / 2 if self.shape == "round" else (across + down) / 2
        if self.radius_mm >= most:
            raise ValueError(
                f"radius_mm = {self.radius_mm} at a spacing of {across} x {down} mm: the dots cover everything; "
                f"it must be less than {most:.4g}"
            )
        return self


class RandomColor(Part):
    """Dense random-colour cells (DelTact: Zhang et al., RA-L 2022), offset at random by up to a cell."""

    kind: Literal["random_color"]
    cell_mm: Positive
    saturation: Fraction = 1.0
    """Upper end; each cell's own lies between 60 and 100 % of it."""
    softness_mm: NonNegative = 0.02
    """Width of the border between two cells; at most cell_mm."""


class Speckle(Part):
    """Random grains, darker or brighter than the coating, as sprayed for digital image correlation."""

    kind: Literal["speckle"]
    grain_mm: Positive
    """Size of a grain. At a coverage of one half a straight line stays within one for 1.11 of it on average."""
    coverage: Annotated[float, Field(gt=0, lt=1)] = 0.5
    reflectance: Color = (0.03, 0.03, 0.03)
    layer: MarkLayer = "in_coating"
    placing: Placing = "z"


class Bitmap(Part):
    """A picture of the user's own, its upper left corner at the image's upper left.

    Its values are sRGB and scale the coating's reflectance, so that white is the bare coating; where it is transparent,
    and around it, there is bare coating, too. Scenes with a bitmap are rendered in colour.
    """

    kind: Literal["bitmap"]
    file: Annotated[str, Field(min_length=1)]
    """PNG, TIFF, JPEG or another format that OpenCV reads, 8 or 16 bit, grey or colour, with or without transparency;
    relative to the scene file."""
    placing: Literal["z", "uv"] = "z"
    """z: along z, by the fields below. uv: by the texture coordinates in a gel's `outer` file (OBJ or PLY), v = 0 being
    the picture's lower edge."""
    width_mm: Annotated[float, Field(ge=0.1, le=1000)] | None = None
    """Width of the whole picture; its height follows from square pixels."""
    offset_mm: Vector2 = (0.0, 0.0)
    """The picture's middle."""
    rotation_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """About its middle; positive turns +x toward +y."""
    layer: MarkLayer = "in_coating"
    """above_coating: what is not transparent is a layer of its own."""

    @model_validator(mode="after")
    def _placed(self) -> "Bitmap":
        if (self.placing == "uv") != (self.width_mm is None):
            raise ValueError('placing = "z" needs width_mm; with "uv" the gel\'s file says where the picture lies')
        if self.placing == "uv" and (any(self.offset_mm) or self.rotation_deg):
            raise ValueError('offset_mm and rotation_deg are for placing = "z"')
        return self


Pattern = Annotated[NoPattern | Dots | RandomColor | Speckle | Bitmap, Field(discriminator="kind")]
