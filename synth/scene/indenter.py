"""The part of a scene's schema that is the indenters."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from synth.scene.part import Part, Positive, Vector3

DEFAULT_FILLET_MM = 0.2
Fillet = Annotated[float, Field(ge=0.01, le=100)] | None
"""Radius of edges. A stated one is kept: the gel's mesh is made fine enough, or the press fails. None: what the mesh
resolves, of analytic shapes at least DEFAULT_FILLET_MM."""


class Posed(Part):
    """Base of the indenters: turned about x, then y, then z before it is pressed with its lowest point first."""

    rotation_deg: Vector3 = (0.0, 0.0, 0.0)
    offset_mm: Vector3 = (0.0, 0.0, 0.0)
    """The point of the body, in its own axes before it is turned, that comes down on the place of the press."""


class Sphere(Posed):
    """Ball."""

    shape: Literal["sphere"]
    radius_mm: Annotated[float, Field(ge=0.05, le=500)]


class Cylinder(Posed):
    """Round bar along its own z axis; unrotated it is a flat punch."""

    shape: Literal["cylinder"]
    radius_mm: Annotated[float, Field(ge=0.05, le=500)]
    length_mm: Annotated[float, Field(ge=0.1, le=500)] = 20.0
    fillet_mm: Fillet = None


class Box(Posed):
    """Block with rounded edges."""

    shape: Literal["box"]
    size_mm: tuple[Positive, Positive, Positive]
    fillet_mm: Fillet = None


class Cone(Posed):
    """Cone whose rounded tip points at the gel."""

    shape: Literal["cone"]
    half_angle_deg: Annotated[float, Field(ge=5, le=85)]
    height_mm: Annotated[float, Field(ge=0.1, le=500)] = 10.0
    fillet_mm: Fillet = None
    """Radius of the tip and of the base's edge."""


class Torus(Posed):
    """Ring in its own xy plane."""

    shape: Literal["torus"]
    radius_mm: Annotated[float, Field(ge=0.1, le=500)]
    tube_mm: Annotated[float, Field(ge=0.05, le=100)]


class MeshIndenter(Part):
    """Triangle surface from a file (`synth.scene.surface_file.FORMATS`), in mm after scaling."""

    shape: Literal["mesh"]
    file: str
    """Relative to the scene's file. In a scene file also a pattern, such as "objects/*.stl": one match is drawn."""
    scale: Positive = 1.0
    size_mm: Positive | None = None
    """Longest edge of the bounding box before it is turned; in place of `scale`."""
    rotation_deg: Vector3 | Literal["any"] = (0.0, 0.0, 0.0)
    """Angles as for the other shapes; "any" draws an orientation, all alike likely."""
    offset_mm: Vector3 | Literal["origin", "lowest"] | None = None
    """The point that comes down on the place of the press: mm from the centre of the bounding box, in the file's axes
    before it is turned; the file's origin; or the point that is lowest once it is turned. Default the lowest on a round
    gel, the centre on others."""
    fillet_mm: Fillet = None
    """Radius to which edges and notches are rounded."""
    cell_mm: Annotated[float, Field(ge=0.01, le=10)] | None = None
    """Spacing of the grid on which its signed distance is sampled; default a third of the radius."""

    @model_validator(mode="after")
    def _one_size(self) -> "MeshIndenter":
        if self.size_mm is not None and self.scale != 1.0:
            raise ValueError("scale and size_mm both say how large it is: give one of them")
        return self


Indenter = Annotated[Sphere | Cylinder | Box | Cone | Torus | MeshIndenter, Field(discriminator="shape")]
