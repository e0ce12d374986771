"""The schema of a scene: one sensor, one contact, one motion, every number fixed.

A scene file may hold distributions in place of numbers (`synth.scene.template`); drawing from them
(`synth.sampling`) gives a `Scene` of this schema. Lengths are mm, angles degrees, stiffness kPa, image quantities
px; the unit is in the field's name. Frame: origin at the centre of the undeformed contact surface, +z from there
through the gel toward the camera, +x right and +y down in the image (a left-handed triple, see docs/decisions.md).
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from synth.scene.gel import PadGel, RoundGel
from synth.scene.indenter import Indenter
from synth.scene.motion import Motion
from synth.scene.numerics import Numerics, Render
from synth.scene.part import Part, Positive
from synth.scene.sensor import Sensor


class Contact(Part):
    """A rigid indenter and Coulomb friction."""

    indenter: Indenter
    friction: Annotated[float, Field(ge=0, le=10)] = 0.5


class Outputs(Part):
    """Whether there are images, and optional channels of flow files."""

    images: bool = True
    """false: nothing is rendered; flow, states and channels are the same."""
    backward: bool = True
    depth: bool = False
    normal: bool = False
    displacement: bool = False
    traction: bool = False
    contact: bool = False
    slip: bool = False
    """Of clips: what moved along the object since the frame before."""
    previous: bool = False
    """Of clips: also the flow from the frame before."""


class Sampling(Part):
    """What a sample is, and how instances are shared: samples of a trajectory, trajectories of a sensor, values."""

    kind: Literal["pairs", "clips"] = "pairs"
    """pairs: two states of a trajectory; clips: all recorded states of one."""
    frames_per_second: Positive = 25.0
    """Of clips."""
    pairs_per_trajectory: Annotated[int, Field(ge=1, le=1000)] = 3
    trajectories_per_sensor: Annotated[int, Field(ge=1, le=100000)] = 2
    common_draws: bool = False
    """Draw by seed and number alone: scenes that differ in fixed values get the same gels and presses."""

    @property
    def samples_per_trajectory(self) -> int:
        return 1 if self.kind == "clips" else self.pairs_per_trajectory


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
        gel, size, motion = self.sensor.gel, self.sensor.gel.size_mm, self.motion
        gel.check_place(motion)
        for name in ("slip", "previous"):
            if getattr(self.outputs, name) and self.sampling.kind != "clips":
                raise ValueError(f'outputs.{name} = true: pairs have no frame before; give sampling.kind = "clips"')
        deepest = 0.85 * (gel.depth_mm - gel.face_mm(*motion.position_mm))
        if motion.depth_mm < -50:
            raise ValueError(f"motion.depth_mm = {motion.depth_mm} leaves the indenter farther than 50 mm off the gel")
        for axis, x, half in zip("xy", motion.position_mm, (size[0] / 2, size[1] / 2), strict=True):
            if abs(x) > half:
                raise ValueError(
                    f"motion.position_mm {axis} = {x} puts the indenter beside the pad (|{axis}| <= {half})"
                )
        for name, pose in motion.stops.items():
            if pose.depth_mm > deepest:
                raise ValueError(
                    f"{name}.depth_mm = {pose.depth_mm} is more than 85 % of the gel's thickness ({gel.depth_mm} mm); "
                    f"at most {deepest:.3g}"
                )
            for axis, s, side in zip("xy", pose.shear_mm, size[:2], strict=True):
                if abs(s) > side:
                    raise ValueError(f"{name}.shear_mm {axis} = {s} is longer than the pad ({side} mm): check its unit")
        # On a curved face the indenter touches above depth 0, so that a press to depth 0 is a leg, too.
        moves = motion.moves + (gel.shape in ("dome", "file") and motion.depth_mm <= 0)
        if motion.then and motion.steps < moves:
            raise ValueError(
                f"motion.steps = {motion.steps} cannot record every pose of motion.then: there are {moves} "
                f"moves, press and shear among them, and each needs a step; at least {moves}"
            )
        if isinstance(gel, RoundGel) and self.numerics.target_error_percent is not None:
            raise ValueError(
                f'numerics.target_error_percent: for a "{gel.shape}" gel no error is predicted; leave it out, and give '
                "edge_length_mm"
            )
        edge, thinnest = self.numerics.edge_length_mm, min(*size, gel.depth_mm)
        if edge is not None and not thinnest / 60 <= edge <= thinnest:
            raise ValueError(
                f"numerics.edge_length_mm = {edge} must lie between {thinnest / 60:.3g} and {thinnest} for this pad"
            )
        return self

    @property
    def warnings(self) -> list[str]:
        """What is possible but unusual."""
        found = []
        gel = self.sensor.gel
        thickness, modulus = gel.depth_mm, gel.youngs_modulus_kpa
        if not 1 <= modulus <= 20_000:
            found.append(f"sensor.gel.youngs_modulus_kpa = {modulus:g}: gels have 10 to 2,000 kPa; check its unit")
        for name, pose in self.motion.stops.items():
            given = f"{name}.shear_mm = {list(pose.shear_mm)}"
            if max(map(abs, pose.shear_mm)) > 2 * thickness:
                found.append(f"{given} is more than twice the gel's thickness ({thickness} mm)")
            ends = zip(self.motion.position_mm, pose.shear_mm, gel.size_mm[:2], strict=True)
            if isinstance(gel, PadGel) and any(abs(start + s) > side / 2 for start, s, side in ends):
                found.append(f"{given} takes the indenter's centre off the pad")
        return found
