"""What `bench render` renders: the undeformed gel and the last state of a press of a scene, made as by `generate`."""

from dataclasses import dataclass

from synth.arrays import Image, Points
from synth.errors import InputError
from synth.pipeline.render_session import FINER_DOME, SUBDIVISIONS
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.variant import Variant
from synth.scene import Render, Scene, Sensor
from synth.scene.sampling import MAX_DRAWS, draw, stream
from synth.scene.template import Template
from synth.scene.validation import validated
from synth.simulate import simulate
from synth.simulate.mesh_rule import MeshRule
from synth.surface import GelSurface


@dataclass(frozen=True, eq=False)
class View:
    """A sensor with one camera, the texture of its coating, and the press; picklable.

    Attributes:
        sensor: with its main camera only.
        texture: (rows, columns, 3) reflectance.
        surface: of the pressed gel.
        pressed: (v, 3) mm, its vertices.
    """

    sensor: Sensor
    texture: Image
    surface: GelSurface
    pressed: Points

    def renderer(self, variant: Variant, render: Render, window: bool = True) -> Renderer:
        """For any state of the pressed surface.

        Args:
            variant: of Mitsuba.
            render: samples and depth.
            window: False: refractive index 1.

        Raises:
            InputError: a light in the view, or a lens that the variant cannot render.
        """
        sensor = self.sensor if window else without_window(self.sensor)
        return Renderer(sensor, render, self.surface, self.texture, variant)


@dataclass(frozen=True, eq=False)
class Subject:
    """One press.

    Attributes:
        scene: the draw.
        seed: of it.
        own: at the scene's own image size.
        small: at the size of the error study.
    """

    scene: Scene
    seed: int
    own: View
    small: View


def press(template: Template, seed: int, size: tuple[int, int] | None) -> Subject:
    """Draw and simulate the scene's first trajectory.

    Args:
        template: the scene.
        seed: of the draw.
        size: image of the error study, px; None: half the scene's own.

    Raises:
        InputError: no draw can be pressed, or the size is not allowed.
    """
    reason = ""
    for attempt in range(MAX_DRAWS):
        try:
            scene = draw(template, seed, 0, attempt)
            sensor = alone(scene.sensor)
            camera = sensor.camera
            small = resized(sensor, size or (max(16, camera.width // 2), max(16, camera.height // 2)))
            mesh = MeshRule.of(scene.numerics).resolution(scene, template.source.parent).mesh
            steps = scene.motion.steps
            result = simulate(scene, mesh, template.source.parent, frames=frozenset({0, steps}))
        except InputError as error:
            reason = str(error)
            continue
        if result.status != "complete":
            reason = result.reason
            continue
        parts = SUBDIVISIONS[result.space.element.order] * (FINER_DOME if sensor.gel.dome_radius_mm else 1)
        surface = GelSurface(result.space.surface, parts)
        pressed = surface.positions(result.states[-1].displacement[result.space.surface_nodes])
        folder = template.source.parent
        textures = [albedo(one, stream(template, seed, "pattern", 0), folder) for one in (sensor, small)]
        views = [View(one, texture, surface, pressed) for one, texture in zip((sensor, small), textures, strict=True)]
        return Subject(scene, seed, *views)
    raise InputError(f"{template.source}: none of {MAX_DRAWS} draws with seed {seed} could be pressed: {reason}")


def alone(sensor: Sensor) -> Sensor:
    """A sensor with its main camera only."""
    return sensor.model_copy(update={"further_cameras": ()})


def without_window(sensor: Sensor) -> Sensor:
    """A sensor whose window does not refract."""
    return sensor.model_copy(update={"window": sensor.window.model_copy(update={"refractive_index": 1.0})})


def resized(sensor: Sensor, size: tuple[int, int]) -> Sensor:
    """A sensor whose main camera has another image size, the field of view kept; blur stays as it is in px.

    Raises:
        InputError: the size is out of the schema's limits.
    """
    content = sensor.model_dump()
    camera = content["camera"]
    across, down = (new / camera[side] for new, side in zip(size, ("width", "height"), strict=True))
    camera |= {"width": size[0], "height": size[1]}
    camera |= {"fx": camera["fx"] * across, "cx": camera["cx"] * across}
    camera |= {"fy": camera["fy"] * down, "cy": camera["cy"] * down}
    return validated(content, f"--size {size[0]}x{size[1]}", Sensor, "sensor")
