"""The part of a scene's schema that is the sensor: coating and lights around gel, window, pattern and cameras."""

import math
from typing import Annotated

from pydantic import Field, model_validator

from synth.scene.camera import Camera, FurtherCamera, Mirror
from synth.scene.gel import Gel
from synth.scene.part import Color, Fraction, NonNegative, Part, Positive, Vector3
from synth.scene.pattern import Pattern
from synth.scene.window import CurvedWindow, PlaneWindow, Window


class Coating(Part):
    """Opaque layer that carries the pattern. roughness 1 and metallic 0 is Lambertian, else Disney principled."""

    reflectance: Color = (0.6, 0.6, 0.6)
    roughness: Annotated[float, Field(ge=0.05, le=1)] = 1.0
    metallic: Fraction = 0.0

    @property
    def is_matt(self) -> bool:
        return self.roughness == 1 and self.metallic == 0


class Light(Part):
    """A rectangular LED inside the index-matched body, radiating toward aim_mm.

    It may also stand in the air that a round window encloses; its light goes on straight at the window's face.

    Lights are real obstacles: they must stay out of the camera's view, and one may shade another.
    """

    position_mm: Vector3
    aim_mm: Vector3 = (0.0, 0.0, 0.0)
    size_mm: tuple[Positive, Positive]
    """Sides along the contact face, and at right angles to that and the aim. A round LED is a square of its area."""
    color: Color
    power: NonNegative
    """Radiant power, in units in which exposure 1 maps a radiance of 1 to full scale."""
    viewing_angle_deg: Annotated[float, Field(ge=10, le=120)] = 120.0
    """Full angle, as in data sheets: half of it off the aim the intensity is half of that along it. 120: Lambertian."""

    @property
    def narrowness(self) -> float:
        """Exponent k of the radiance cos^k θ at the angle θ off the aim; 0 for a Lambertian LED."""
        wide = self.viewing_angle_deg == 120
        return 0.0 if wide else -math.log(2) / math.log(math.cos(math.radians(self.viewing_angle_deg / 2))) - 1

    @property
    def radiance(self) -> Vector3:
        """Radiance along the aim, by channel: the power is its integral of cos^(k + 1) θ over area and hemisphere."""
        width, height = self.size_mm
        level = self.power * (self.narrowness + 2) / (2 * math.pi * width * height)
        return (level * self.color[0], level * self.color[1], level * self.color[2])


class MeasuredLight(Part):
    """Light as GelSight publishes it (github.com/gelsightinc/gssim), in place of what the lights would give.

    Its LEDs are the lights in their order: power and color scale what was measured, places decide what is in shadow.
    """

    file: Annotated[str, Field(min_length=1)]
    """The device's YAML file, relative to the scene file."""
    flat_field: Annotated[str, Field(min_length=1)] | None = None
    """The picture that the file names as modelfile, relative to the scene file; None: light as corrected by it."""


class Sensor(Part):
    """Everything but contact and motion: gel, optics and light."""

    gel: Gel
    window: Window = PlaneWindow()
    coating: Coating = Coating()
    pattern: Pattern
    lights: tuple[Light, ...] = Field(min_length=1)
    measured_light: MeasuredLight | None = None
    camera: Camera
    further_cameras: tuple[FurtherCamera, ...] = ()
    mirrors: tuple[Mirror, ...] = ()
    """Mirrors between cameras and window. They take no part in the lighting: they neither shade nor light the gel."""

    @property
    def views(self) -> dict[str, "Sensor"]:
        """The sensor as each camera sees it: the main camera's under "", the others' by their names."""
        others = {camera.name: self.model_copy(update={"camera": camera}) for camera in self.further_cameras}
        return {"": self, **others}

    @property
    def cameras(self) -> dict[str, Camera]:
        """All cameras, by their places in a scene file."""
        further = {f"further_cameras[{i}]": camera for i, camera in enumerate(self.further_cameras)}
        return {"camera": self.camera, **further}

    @model_validator(mode="after")
    def _arranged(self) -> "Sensor":
        names = [camera.name for camera in self.further_cameras]
        if len(set(names)) < len(names):
            raise ValueError(f"further_cameras: names must differ, they are {', '.join(names)}")
        if isinstance(self.window, CurvedWindow):
            self._check_inside(self.window)
        else:
            self._check_beyond()
        placing, allowed = getattr(self.pattern, "placing", "z"), self.gel.placings
        if placing not in allowed:
            raise ValueError(
                f'pattern.placing = "{placing}" does not suit gel.shape = "{self.gel.shape}", which allows '
                f"{', '.join(allowed)}"
            )
        if not any(light.power for light in self.lights):
            raise ValueError("lights: no light has power; give at least one of them a power above 0")
        thickness = self.gel.size_mm[2]
        outside = thickness + self.window.thickness_mm
        for i, light in enumerate(self.lights):
            if not 0 < light.position_mm[2] < outside:
                raise ValueError(
                    f"lights[{i}].position_mm z = {light.position_mm[2]} must lie inside the gel and window, "
                    f"0 < z < {outside}"
                )
            if light.position_mm[2] <= self.gel.face_mm(*light.position_mm[:2]):
                raise ValueError(f"lights[{i}].position_mm lies outside the curved gel")
        return self

    def _check_inside(self, window: CurvedWindow) -> None:
        """Refuse what does not fit into the air that a round window encloses."""
        for where, camera in self.cameras.items():
            if window.clearance_mm(camera.position_mm) <= 0:
                raise ValueError(
                    f"{where}.position_mm = {list(camera.position_mm)} must lie inside the window's "
                    f"{self.window.shape}, nearer than radius_mm = {window.radius_mm:.4g} to its axis or centre"
                )
            if camera.aperture_mm:
                raise ValueError(
                    f"{where}.aperture_mm = {camera.aperture_mm}: behind a round window only a pinhole is modelled; "
                    "leave it out, and use blur_px for a blur that is the same in all of the image"
                )
        if self.mirrors:
            raise ValueError(f"mirrors stand before a flat window only, this one is a {self.window.shape}")

    def _check_beyond(self) -> None:
        """Refuse cameras and mirrors that are not beyond a flat window."""
        thickness = self.gel.size_mm[2]
        outside = thickness + self.window.thickness_mm
        for where, camera in self.cameras.items():
            if camera.position_mm[2] <= outside:
                raise ValueError(
                    f"{where}.position_mm z = {camera.position_mm[2]} lies inside the sensor; "
                    f"it must be beyond the window, z > {outside} (gel {thickness} + window {self.window.thickness_mm})"
                )
            if camera.lowest_mm <= outside:
                raise ValueError(
                    f"{where}.aperture_mm = {camera.aperture_mm}: the tilted pupil reaches down to z = "
                    f"{camera.lowest_mm:.4g}, into the window; it must stay above z = {outside}"
                )
            if camera.look_at_mm[2] >= camera.position_mm[2] and not self.mirrors:
                raise ValueError(
                    f"{where}.look_at_mm must lie on the gel's side of the camera (smaller z); only a mirror could "
                    "turn its view back"
                )
        for i, mirror in enumerate(self.mirrors):
            if mirror.lowest_mm <= outside:
                raise ValueError(
                    f"mirrors[{i}] reaches down to z = {mirror.lowest_mm:.4g}; mirrors stand in air, beyond the "
                    f"window: z > {outside}"
                )
