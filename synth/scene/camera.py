"""The part of a scene's schema that forms images: cameras with their lenses, and flat mirrors."""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from synth.arrays import FloatArray
from synth.scene.part import Fraction, NonNegative, Part, Positive, Vector3

COEFFICIENTS = {"pinhole": "k1, k2, p1, p2, k3", "fisheye": "k1, k2, k3, k4"}
"""Names of a lens's distortion coefficients, as OpenCV orders them."""


class Camera(Part):
    """A camera in air, beyond a flat window or within a round one. Right is +x and down +y for a view along -z."""

    width: Annotated[int, Field(ge=16, le=8192)]
    height: Annotated[int, Field(ge=16, le=8192)]
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    position_mm: Vector3
    look_at_mm: Vector3 = (0.0, 0.0, 0.0)
    lens: Literal["pinhole", "fisheye"] = "pinhole"
    """pinhole: Brown-Conrady; fisheye: Kannala-Brandt as in cv2.fisheye, up to 220 degrees from side to side."""
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """Coefficients as in OpenCV: k1, k2, p1, p2, k3 of a pinhole lens; k1, k2, k3, k4 of a fisheye lens."""
    exposure: Positive = 1.0
    gamma: Annotated[float, Field(ge=0.2, le=4)] = 2.2
    """Encoded value = linear value ** (1 / gamma)."""
    blur_px: NonNegative = 0.0
    """Standard deviation of the lens's Gaussian point spread, everywhere the same; defocus adds to it."""
    aperture_mm: NonNegative = 0.0
    """Diameter of the entrance pupil, a disc around position_mm; 0: a pinhole, sharp everywhere. The flow is that of
    the pupil's centre in either case: the middle of each blurred point."""
    focus_mm: Positive | None = None
    """How far from the pupil things are sharp, along the viewing axis, by mirrors and on into the gel, in true mm: for
    a camera that looks straight down, its own z less that of the sharp plane. Only an aperture needs it."""
    vignetting: Fraction = 0.0
    """Relative loss of light at the image's corner, growing with the square of the distance from (cx, cy)."""
    rest_map: Annotated[str, Field(min_length=1)] | None = None
    """Picture of the camera's size, relative to the scene file, of factors of the linear image that stay fixed to it:
    what lights and vignetting do not explain of a real sensor at rest, such as dust. Of 8 or 16 bits, 128 or 32768 is
    a factor of 1; a grey TIFF of floats holds the factors themselves. Scenes with one are rendered in colour."""
    read_noise: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Standard deviation as a fraction of full scale, linear, independent of the signal."""
    shot_noise: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    """Standard deviation at full scale; grows with the square root of the linear signal."""
    bit_depth: Literal[8, 10, 12, 14, 16] = 8

    @model_validator(mode="after")
    def _coefficients(self) -> "Camera":
        names = COEFFICIENTS[self.lens]
        if len(self.distortion) != names.count(",") + 1:
            raise ValueError(
                f"distortion has {len(self.distortion)} numbers; a {self.lens} lens needs distortion = [{names}], "
                "zeros for an ideal lens"
            )
        return self

    @model_validator(mode="after")
    def _focused(self) -> "Camera":
        if not self.aperture_mm:
            return self
        if self.lens == "fisheye":
            raise ValueError(
                f"aperture_mm = {self.aperture_mm}: a fisheye lens has no flat plane of focus, and it is sharp nearly "
                "everywhere; leave aperture_mm out, and use blur_px for a blur that is the same in all of the image"
            )
        if self.focus_mm is None:
            raise ValueError(
                f"aperture_mm = {self.aperture_mm} needs focus_mm, the distance at which the picture is sharp; for the "
                "undeformed gel it is position_mm's z, where the camera looks straight down"
            )
        if self.aperture_mm > self.focus_mm:
            raise ValueError(
                f"aperture_mm = {self.aperture_mm} is wider than focus_mm = {self.focus_mm}; no lens takes in so "
                "wide a cone: both are in mm, and the aperture is the pupil's diameter, not the f-number"
            )
        return self

    @property
    def lowest_mm(self) -> float:
        """Smallest z of the lens's pupil, mm."""
        along = [at - eye for at, eye in zip(self.look_at_mm, self.position_mm, strict=True)]
        length = math.hypot(*along)
        level = math.hypot(along[0], along[1]) / length if length > 0 else 1.0
        return self.position_mm[2] - self.aperture_mm / 2 * level


class FurtherCamera(Camera):
    """Another camera that looks at the same gel; its files lie in a folder of its name in each sample."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_\-]+$")]


class Mirror(Part):
    """A flat, ideal, rectangular mirror in air between cameras and window; its back is black."""

    position_mm: Vector3
    """The mirror's centre."""
    normal: Vector3
    """Direction away from the reflecting side; of any length."""
    size_mm: tuple[Positive, Positive]
    """Sides along the contact face, and at right angles to that and the normal; along x and y for a normal along z."""
    rotation_deg: float = 0.0
    """Turns the rectangle in its own plane, from its first size's direction toward its second's."""

    @property
    def axes(self) -> FloatArray:
        """(3, 3) unit vectors as rows: along the first size, along the second size, and the normal."""
        normal = np.array(self.normal) / math.hypot(*self.normal)
        level, turn = math.hypot(normal[0], normal[1]), math.radians(self.rotation_deg)
        along = np.array([-normal[1], normal[0], 0.0]) / level if level > 1e-9 else np.array([1.0, 0.0, 0.0])
        across = np.cross(normal, along)
        c, s = math.cos(turn), math.sin(turn)
        return np.stack([c * along + s * across, c * across - s * along, normal])

    @property
    def lowest_mm(self) -> float:
        """Smallest z of the mirror, mm."""
        first, second, _ = np.abs(self.axes[:, 2])
        return float(self.position_mm[2] - (first * self.size_mm[0] + second * self.size_mm[1]) / 2)

    @model_validator(mode="after")
    def _facing(self) -> "Mirror":
        if math.hypot(*self.normal) < 1e-9:
            raise ValueError("normal is zero: give the direction that the mirror faces, such as [0, -1, -1]")
        return self
