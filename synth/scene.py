"""The schema of a scene: one sensor, one contact, one motion, every number fixed.

A scene file may hold distributions in place of numbers (`synth.template`); drawing from them (`synth.sampling`)
gives a `Scene` of this schema. Lengths are mm, angles degrees, stiffness kPa, image quantities px; the unit is in the
field's name. Frame: origin at the centre of the undeformed contact surface, +z from there through the gel toward the
camera, +x right and +y down in the image (a left-handed triple, see docs/decisions.md).
"""

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from synth.scene_camera import Camera, FurtherCamera, Mirror
from synth.scene_gel import Gel as Gel
from synth.scene_gel import Layer as Layer
from synth.scene_indenters import Color, Fraction, Indenter, NonNegative, Part, Positive, Vector2, Vector3
from synth.scene_pattern import Bitmap as Bitmap
from synth.scene_pattern import Dots as Dots
from synth.scene_pattern import NoPattern as NoPattern
from synth.scene_pattern import Pattern
from synth.scene_pattern import RandomColor as RandomColor
from synth.scene_pattern import Speckle as Speckle


class Window(Part):
    """Rigid clear support between gel and camera, index-matched to the gel; flat, from z = gel thickness on.

    Its outer face refracts; light that it reflects back into the body is left out.
    """

    refractive_index: Annotated[float, Field(ge=1, le=2.5)] = 1.45
    thickness_mm: Annotated[float, Field(ge=0, le=100)] = 5.0


class Coating(Part):
    """Opaque layer that carries the pattern. roughness 1 and metallic 0 is Lambertian, else Disney principled."""

    reflectance: Color = (0.6, 0.6, 0.6)
    roughness: Annotated[float, Field(ge=0.05, le=1)] = 1.0
    metallic: Fraction = 0.0

    @property
    def is_matt(self) -> bool:
        """Whether it is Lambertian."""
        return self.roughness == 1 and self.metallic == 0


class Light(Part):
    """A rectangular LED inside the index-matched body, radiating as a Lambertian area toward aim_mm.

    Lights are real obstacles: they must stay out of the camera's view, and one may shade another.
    """

    position_mm: Vector3
    aim_mm: Vector3 = (0.0, 0.0, 0.0)
    size_mm: tuple[Positive, Positive]
    """Along the contact face, and at right angles to that and to the aim."""
    color: Color
    power: NonNegative
    """Radiant power, in units in which exposure 1 maps a radiance of 1 to full scale."""


class Sensor(Part):
    """Everything that belongs to the finger."""

    gel: Gel
    window: Window = Window()
    coating: Coating = Coating()
    pattern: Pattern
    lights: tuple[Light, ...] = Field(min_length=1)
    camera: Camera
    further_cameras: tuple[FurtherCamera, ...] = ()
    mirrors: tuple[Mirror, ...] = ()
    """Between cameras and window. They take no part in the lighting: a mirror neither shades nor lights the gel."""

    @property
    def views(self) -> dict[str, "Sensor"]:
        """The sensor as each camera sees it: the main camera's under "", the others' by their names."""
        others = {camera.name: self.model_copy(update={"camera": camera}) for camera in self.further_cameras}
        return {"": self, **others}

    @model_validator(mode="after")
    def _arranged(self) -> "Sensor":
        thickness = self.gel.size_mm[2]
        outside = thickness + self.window.thickness_mm
        cameras: dict[str, Camera] = {"camera": self.camera}
        cameras.update({f"further_cameras[{i}]": camera for i, camera in enumerate(self.further_cameras)})
        for where, camera in cameras.items():
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
        names = [camera.name for camera in self.further_cameras]
        if len(set(names)) < len(names):
            raise ValueError(f"further_cameras: names must differ, they are {', '.join(names)}")
        for i, mirror in enumerate(self.mirrors):
            if mirror.lowest_mm <= outside:
                raise ValueError(
                    f"mirrors[{i}] reaches down to z = {mirror.lowest_mm:.4g}; mirrors stand in air, beyond the "
                    f"window: z > {outside}"
                )
        for i, light in enumerate(self.lights):
            if not 0 < light.position_mm[2] < outside:
                raise ValueError(
                    f"lights[{i}].position_mm z = {light.position_mm[2]} must lie inside the gel and window, "
                    f"0 < z < {outside}"
                )
            if light.position_mm[2] <= self.gel.face_mm(*light.position_mm[:2]):
                raise ValueError(f"lights[{i}].position_mm lies outside the domed gel")
        return self


class Contact(Part):
    """A rigid indenter and Coulomb friction."""

    indenter: Indenter
    friction: Annotated[float, Field(ge=0, le=10)] = 0.5


class Pose(Part):
    """Where the indenter is, as Motion's own fields give the end of its press and shear."""

    depth_mm: NonNegative
    shear_mm: Vector2 = (0.0, 0.0)
    twist_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0


class Motion(Part):
    """Press at position_mm to depth_mm, then shear and twist together about the indenter's axis, then what follows."""

    depth_mm: float
    """How far the indenter's lowest point goes past the undeformed surface; negative: it stays off by so much."""
    shear_mm: Vector2 = (0.0, 0.0)
    twist_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Positive turns +x toward +y."""
    position_mm: Vector2 = (0.0, 0.0)
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
        """How many legs the way has: press, shear with twist, and one to each pose that differs from the one before."""
        stops = [(min(self.depth_mm, 0.0), (0.0, 0.0), 0.0), (self.depth_mm, (0.0, 0.0), 0.0)]
        stops += [(pose.depth_mm, pose.shear_mm, pose.twist_deg) for pose in self.poses.values()]
        return sum(start != end for start, end in pairwise(stops))


class Render(Part):
    """Path tracing."""

    samples_per_pixel: Annotated[int, Field(ge=1, le=65536)] | Literal["auto"] = 36
    """At least so many; rounded up to a full grid and a multiple of the number of lights. auto: for every sensor drawn,
    so many that the renderer's noise is a quarter of the main camera's own."""
    max_depth: Annotated[int, Field(ge=2, le=64)] = 4
    """Longest light path in surfaces and lights; 2 is direct light only. The window does not count."""
    light: Literal["path_traced", "separated"] = "path_traced"
    """separated: direct light in closed form, what is blocked of it and bounced light sampled at their own rates; with
    as many samples a quarter of the noise or less (docs/reports/light.md). For matt coatings; scalar variants, where
    there is neither LLVM nor a GPU, path-trace what has the same expectation."""


Cells = Annotated[int, Field(ge=4, le=200, multiple_of=2)]
"""An even number of elements, so that a mesh is its own mirror image."""


class Numerics(Part):
    """Resolution and tolerances of the simulation."""

    element: Literal["auto", "p1p1", "p2p1"] = "auto"
    """auto is p2p1: at every run time it was the more accurate."""
    target_error_px: Positive | None = None
    """Root-mean-square error that the flow over the contact face may have from the simulation; default 0.5. The mesh is
    made as fine under each draw's contact as this asks for."""
    edge_length_mm: Positive | None = None
    """Instead of a target: one fTetWild mesh for all draws with tetrahedra of this edge at the contact face."""
    solver: Literal["single", "batched"] = "single"
    """batched: many trajectories at once on one mesh for all draws of a pad, for GPUs; `cells` or edge_length_mm say
    which, and a target is only what `plan` compares with. The same laws and tolerances, other meshes: other samples."""
    cells: tuple[Cells, Cells, Annotated[int, Field(ge=1, le=20)]] = (16, 12, 2)
    """Elements of the batched solver's mesh along x and y, where they are even in size, and through the thickness."""
    max_step_mm: Positive = 0.25
    """Longest motion of the indenter in one load step; steps are halved when Newton fails."""
    tolerance: Annotated[float, Field(ge=1e-12, le=1e-2)] = 1e-6
    """Newton stops when the residual is below this fraction of the reaction force."""
    penalty: Annotated[float, Field(ge=1, le=1e4)] = 50.0
    """Contact stiffness in multiples of E per mm, before augmented-Lagrangian updates; sharp bodies get up to four
    times as much."""

    @model_validator(mode="after")
    def _one_resolution(self) -> "Numerics":
        if self.target_error_px is not None and self.edge_length_mm is not None:
            raise ValueError("target_error_px and edge_length_mm both fix the mesh: give one of them")
        return self


class Outputs(Part):
    """Optional channels of flow.exr."""

    backward: bool = True
    depth: bool = False
    normal: bool = False
    displacement: bool = False
    traction: bool = False
    contact: bool = False


class Sampling(Part):
    """How draws are shared: samples of one trajectory, trajectories of one sensor."""

    pairs_per_trajectory: Annotated[int, Field(ge=1, le=1000)] = 2
    trajectories_per_sensor: Annotated[int, Field(ge=1, le=100000)] = 2


class Scene(Part):
    """One fully determined scene."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9_\-]+$")]
    description: str = ""
    references: tuple[str, ...] = ()
    sensor: Sensor
    contact: Contact
    motion: Motion
    render: Render = Render()
    numerics: Numerics = Numerics()
    outputs: Outputs = Outputs()
    sampling: Sampling = Sampling()

    @model_validator(mode="after")
    def _plausible(self) -> "Scene":
        size, motion = self.sensor.gel.size_mm, self.motion
        deepest = 0.85 * (size[2] - self.sensor.gel.face_mm(*motion.position_mm))
        if motion.depth_mm < -50:
            raise ValueError(f"motion.depth_mm = {motion.depth_mm} leaves the indenter farther than 50 mm off the gel")
        for axis, x, half in zip("xy", motion.position_mm, (size[0] / 2, size[1] / 2), strict=True):
            if abs(x) > half:
                raise ValueError(
                    f"motion.position_mm {axis} = {x} puts the indenter beside the pad (|{axis}| <= {half})"
                )
        for name, pose in motion.poses.items():
            if pose.depth_mm > deepest:
                raise ValueError(
                    f"{name}.depth_mm = {pose.depth_mm} is more than 85 % of the gel's thickness ({size[2]} mm); "
                    f"at most {deepest:.3g}"
                )
            for axis, s, side in zip("xy", pose.shear_mm, size[:2], strict=True):
                if abs(s) > side:
                    raise ValueError(f"{name}.shear_mm {axis} = {s} is longer than the pad ({side} mm): check its unit")
        if motion.then and motion.steps < motion.moves:
            raise ValueError(
                f"motion.steps = {motion.steps} cannot record every pose of motion.then: there are {motion.moves} "
                f"moves, press and shear among them, and each needs a step; at least {motion.moves}"
            )
        if self.numerics.edge_length_mm is not None and self.sensor.gel.layers:
            raise ValueError(
                "numerics.edge_length_mm: fTetWild's meshes have no layers; leave it out for a layered gel"
            )
        edge = self.numerics.edge_length_mm
        if edge is not None and not min(size) / 60 <= edge <= min(size):
            raise ValueError(
                f"numerics.edge_length_mm = {edge} must lie between {min(size) / 60:.3g} and {min(size)} for this pad"
            )
        return self

    @property
    def warnings(self) -> list[str]:
        """What is possible but unusual."""
        found = []
        x, y, thickness = self.sensor.gel.size_mm
        for name, pose in self.motion.poses.items():
            given = f"{name}.shear_mm = {list(pose.shear_mm)}"
            if max(map(abs, pose.shear_mm)) > 2 * thickness:
                found.append(f"{given} is more than twice the gel's thickness ({thickness} mm)")
            ends = zip(self.motion.position_mm, pose.shear_mm, (x / 2, y / 2), strict=True)
            if any(abs(start + s) > half for start, s, half in ends):
                found.append(f"{given} takes the indenter's centre off the pad")
        return found
