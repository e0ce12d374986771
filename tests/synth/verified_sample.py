"""A small sample whose flow is exact and whose images show a painted pattern, without solver and renderer."""

import numpy as np
from kinematic_double import LENS, sensor, sheet

from synth.arrays import FloatArray, Points
from synth.dataset.sample import CameraFrames, Sample
from synth.dataset.sample_reader import SampleData
from synth.flow.exact import exact_flow
from synth.flow.field import FlowField
from synth.flow.trace import trace
from synth.flow.view import View
from synth.optics import Optics
from synth.scene import Scene, Sensor
from synth.surface import GelSurface
from synth.verify.camera import ForwardCamera
from synth.verify.motion import check_motion
from synth.verify.report import Check
from synth.verify.sheet import Sheet

WIDTH, HEIGHT = 160, 120
NOISE = 0.004
SURFACE = sheet(20, 15, 20.0, 15.0, 2)


def scene(pattern: dict[str, object] | None = None, index: float = 1.45, **camera: object) -> Scene:
    """A 20 x 15 mm pad that a little more than fills a 160 x 120 image, under an oblique camera with a lens."""
    view = {"position_mm": (1.0, -0.7, 24.0), "look_at_mm": (0.2, 0.1, 0.0), "distortion": LENS}
    size = {"width": WIDTH, "height": HEIGHT, "fx": 175.0, "fy": 176.0, "cx": 79.3, "cy": 60.4}
    drawn = sensor(index=index, **{**view, **size, "read_noise": NOISE, **camera}).model_dump()
    drawn["pattern"] = pattern or {"kind": "speckle", "grain_mm": 0.5}
    press = {"contact": {"indenter": {"shape": "sphere", "radius_mm": 4}}, "motion": {"depth_mm": 1}}
    return Scene.model_validate({"name": "double", "sensor": drawn, **press})


def pressed(depth: float, shear: tuple[float, float], turn: float = 0.0) -> FloatArray:
    """Displacement (n, 3) mm of the surface's nodes: a dent of 3 mm radius that is carried along and twisted."""
    nodes = SURFACE.coarse.nodes
    arm = nodes[:, :2] - (0.4, -0.3)
    dent = np.exp(-((arm**2).sum(1)) / 9.0)
    lateral = dent[:, None] * (np.array(shear) + turn * arm @ np.array([[0.0, 1.0], [-1.0, 0.0]]))
    return np.column_stack([lateral, depth * dent])


def make_sample(drawn: Scene, displacement1: FloatArray, displacement2: FloatArray) -> SampleData:
    optics = Optics.of(drawn.sensor)
    states = [SURFACE.positions(u) for u in (displacement1, displacement2)]
    flow = exact_flow(View(SURFACE, optics), *states)
    rng = np.random.default_rng(0)
    images = [_paint(positions, optics, drawn, rng) for positions in states]
    return SampleData(images[0], images[1], flow, SURFACE, displacement1, displacement2, {})


def sheets(sensor: Sensor, surface: GelSurface, *states: Points) -> list[Sheet]:
    """States of a surface as verification looks at them."""
    camera = ForwardCamera.of(sensor)
    return [Sheet(camera, surface.triangles, state, sensor.camera.width, sensor.camera.height) for state in states]


Checked = tuple[FlowField, dict[str, Check]]


def motion_checks(sensor: Sensor, surface: GelSurface, first: Points, second: Points) -> Checked:
    """The exact flow between two states, both ways, and the checks of it by name."""
    flow = exact_flow(View(surface, Optics.of(sensor)), first, second)
    near, far = sheets(sensor, surface, first, second)
    checks = check_motion("forward", near, far, flow.forward, flow.forward_visible)
    checks += check_motion("backward", far, near, flow.backward, flow.backward_visible)
    return flow, {check.name: check for check in checks}


def as_sample(index: int, drawn: Scene, data: SampleData) -> Sample:
    seen = CameraFrames(data.flow.forward.shape[:2], data.images, (data.flow,))
    moved = (data.displacement1, data.displacement2)
    return Sample(index, 0, (0, 1), 0, drawn, data.surface, moved, {"": seen})


def _paint(positions: Points, optics: Optics, drawn: Scene, rng: np.random.Generator) -> np.ndarray:
    """Waves in material coordinates under light that depends on place, 2 x 2 samples a pixel, with noise, 8 bit."""
    camera, surface = drawn.sensor.camera, SURFACE
    row, column = np.mgrid[: 2 * camera.height, : 2 * camera.width]
    rays = optics.look(np.column_stack([column.ravel(), row.ravel()]) / 2 + 0.25)
    hits = trace(positions, surface.triangles, rays.origins, rays.directions)
    x, y, _ = hits.interpolate(surface.triangles, surface.material).T
    z = hits.interpolate(surface.triangles, positions)[:, 2]
    albedo = 0.45 + 0.2 * np.sin(4.1 * x + 1.3 * np.sin(1.7 * y)) + 0.2 * np.sin(4.3 * y + 1.5 * np.sin(1.1 * x))
    bright = np.nan_to_num(albedo * (0.7 + 0.02 * x - 0.015 * y) * (1 - 0.15 * z))
    linear = bright.reshape(camera.height, 2, camera.width, 2).mean((1, 3))
    noisy = linear + camera.read_noise * rng.standard_normal(linear.shape)
    return np.rint(255 * np.clip(noisy, 0, 1) ** (1 / camera.gamma)).astype(np.uint8)
