"""What the benchmarks of rendering and of flow look at: a scene's first press, simulated as `generate` does."""

from dataclasses import dataclass

from synth.arrays import Image, Points
from synth.errors import InputError
from synth.pipeline.render_session import FINER_DOME, SUBDIVISIONS
from synth.press.press import MeshRule
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.variant import Variant
from synth.sampling import MAX_DRAWS, draw, stream
from synth.scene import Render, Scene, Sensor
from synth.scene.template import Template
from synth.scene.validation import validated
from synth.simulate import simulate
from synth.surface import GelSurface


@dataclass(frozen=True, eq=False)
class View:
    """A pressed gel and the sensor that looks at it.

    Attributes:
        sensor: with its main camera only.
        texture: (rows, columns, 3) reflectance of the coating.
        surface: of the gel.
        pressed: (v, 3) mm, vertices of the surface in the last state of the press.
    """

    sensor: Sensor
    texture: Image
    surface: GelSurface
    pressed: Points

    @property
    def states(self) -> tuple[Points, Points]:
        """Vertices of the undeformed and of the pressed gel, (v, 3) mm each."""
        return self.surface.material, self.pressed

    def renderer(self, variant: Variant, render: Render) -> Renderer:
        """A renderer of any state of this surface; raises what `Renderer` does."""
        return Renderer(self.sensor, render, self.surface, self.texture, variant)


@dataclass(frozen=True, eq=False)
class Press:
    """A random instance of a scene, and the surface of its gel before and after the press (`View.pressed`)."""

    template: Template
    seed: int
    scene: Scene
    surface: GelSurface
    pressed: Points

    def view(self, scale: float = 1.0) -> View:
        """The press in the scene's main camera, whose image is `scale` times as large in each direction."""
        sensor = main_camera(self.scene.sensor, scale)
        texture = albedo(sensor, stream(self.template, self.seed, "pattern", 0), self.template.source.parent)
        return View(sensor, texture, self.surface, self.pressed)


def press(template: Template, seed: int) -> Press:
    """The first trajectory of a scene that can be simulated to its end.

    Raises:
        InputError: None of the random instances that `generate` would try can be.
    """
    reason, folder = "", template.source.parent
    for attempt in range(MAX_DRAWS):
        try:
            scene = draw(template, seed, 0, attempt)
            mesh = MeshRule.of(scene).resolution(scene, folder).mesh
            result = simulate(scene, mesh, folder, frames=frozenset({0, scene.motion.steps}))
        except InputError as error:
            reason = str(error)
            continue
        if result.status == "complete":
            finer = FINER_DOME if scene.sensor.gel.dome_radius_mm else 1
            surface = GelSurface(result.space.surface, SUBDIVISIONS[result.space.surface.is_quadratic] * finer)
            pressed = surface.positions(result.states[-1].displacement[result.space.surface_nodes])
            return Press(template, seed, scene, surface, pressed)
        reason = result.reason
    raise InputError(f"{template.source}: none of {MAX_DRAWS} presses of seed {seed} can be simulated: {reason}")


def without_window(sensor: Sensor) -> Sensor:
    """A sensor whose window does not refract."""
    return sensor.model_copy(update={"window": sensor.window.model_copy(update={"refractive_index": 1.0})})


def main_camera(sensor: Sensor, scale: float) -> Sensor:
    """A sensor with its main camera only, whose image is `scale` times as large in each direction; same field of view.

    Raises:
        InputError: The schema does not allow the size.
    """
    content = sensor.model_dump() | {"further_cameras": ()}
    camera = content["camera"]
    for side, axis in (("width", "x"), ("height", "y")):
        size = max(16, round(scale * camera[side]))
        factor = size / camera[side]
        camera |= {side: size, f"f{axis}": camera[f"f{axis}"] * factor, f"c{axis}": camera[f"c{axis}"] * factor}
    return validated(content, f"an image scaled by {scale:g}", Sensor, "sensor")
