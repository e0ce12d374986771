"""Separated light against path tracing: error of pictures, time of frames, and what two flow methods make of it.

Pictures are judged as in `synth.bench.render_error`. For flow every picture of the undeformed gel is paired with one of
the pressed gel and photographed with the noise of the camera; the reference's pair gets the same noise. OpenCV's DIS
(medium) and Farnebäck's method (Two-Frame Motion Estimation Based on Polynomial Expansion, SCIA 2003; window 15) then
measure both. The reference's two halves against each other show how much of a difference is the reference's own.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from synth.arrays import Image
from synth.bench.render_error import Errors, Reference, errors, measured_camera_noise
from synth.bench.render_flow import Grey, Truth, dis, truth
from synth.bench.render_measure import Say
from synth.bench.render_subject import View
from synth.flow.field import FlowArray
from synth.render.camera_image import camera_image
from synth.render.variant import Variant
from synth.scene import Camera, Render

STATES = ("undeformed", "pressed")
SEPARATED_SAMPLES = (9, 16, 36)
REPEATS, NOISE_DRAWS = 3, 2
_SEEDS = 5000


@dataclass(frozen=True)
class Row:
    """One way to render one state of one scene; its reference is path traced.

    Attributes:
        scene, state, light: names.
        samples: per pixel, as really taken.
        processor_s: of a frame, median, all threads.
        camera_noise: levels of 255.
        errors: of the picture.
    """

    scene: str
    state: str
    light: str
    samples: int
    processor_s: float
    camera_noise: float
    errors: Errors

    @property
    def holds(self) -> bool:
        """Whether the error is within a quarter of the camera's own noise."""
        return self.errors.rmse <= self.camera_noise / 4


@dataclass(frozen=True)
class FlowRow:
    """A method on pairs of one scene, camera noise on; px, over the points visible in both pictures.

    Attributes:
        scene, light, method: names; light "reference" compares the reference's halves.
        samples: per pixel.
        change: of the mean endpoint error, and typical_change of the median pixel's.
        difference: mean distance of the two measured flows, and typical_difference the median pixel's.
    """

    scene: str
    light: str
    samples: int
    method: str
    change: float
    typical_change: float
    difference: float
    typical_difference: float


def farneback(first: Grey, second: Grey) -> FlowArray:
    """Flow (H, W, 2) px of two grey images (H, W) uint8."""
    import cv2

    start = np.zeros((*first.shape, 2), dtype=np.float32)
    return np.asarray(cv2.calcOpticalFlowFarneback(first, second, start, 0.5, 5, 15, 3, 7, 1.5, 0), dtype=np.float32)


METHODS: dict[str, Callable[[Grey, Grey], FlowArray]] = {"DIS": dis, "Farneback": farneback}


def compare(
    name: str, view: View, variant: Variant, own: Render, reference: int, say: Say = lambda _: None
) -> Iterator[Row | FlowRow]:
    """Rows of one scene, its own path-traced samples first.

    Args:
        name: of the scene.
        view: sensor and press.
        variant: that renders.
        own: the scene's settings.
        reference: samples per pixel of the path-traced reference, both halves together.
        say: told what was done.

    Raises:
        InputError: a sensor that separated light cannot render, or nothing visible in both pictures.
    """
    places, camera, exact = (view.surface.material, view.pressed), view.sensor.camera, truth(view)
    samples = 36 if own.samples_per_pixel == "auto" else own.samples_per_pixel
    wanted = [("path_traced", samples), *(("separated", n) for n in SEPARATED_SAMPLES)]
    for light, n in wanted:  # refusals come before minutes of work
        view.renderer(variant, _render(own, light, n))
    renderer = view.renderer(variant, _render(own, "path_traced", reference // 2))
    halves = [(renderer.radiance(place, 1), renderer.radiance(place, 2)) for place in places]
    say(f"{name}: reference of 2 x {renderer.samples_per_pixel} samples a pixel")
    aims: list[Image] = [np.mean(half, axis=0, dtype=np.float32) for half in halves]
    yield from _flows(name, ("reference", reference // 2), [halves[0]], [halves[1]], exact, camera)
    for light, n in wanted:
        renderer = view.renderer(variant, _render(own, light, n))
        pictures: list[list[Image]] = []
        for state, place, half in zip(STATES, places, halves, strict=True):
            renderer.radiance(place, 3)  # compiles
            taken, seconds = [], []
            for k in range(REPEATS):
                began = time.process_time()
                taken.append(renderer.radiance(place, _SEEDS + k))
                seconds.append(time.process_time() - began)
            found = errors(taken, Reference(half, reference), camera)
            noise = measured_camera_noise(half[0], camera)
            row = Row(name, state, light, renderer.samples_per_pixel, median(seconds), noise, found)
            say(f"{name}, {state}: {light}, {row.samples} samples: {row.processor_s:.2f} s, {found.rmse:.3f} levels")
            yield row
            pictures.append(taken)
        first, second = ([(picture, aim) for picture in taken] for taken, aim in zip(pictures, aims, strict=True))
        yield from _flows(name, (light, renderer.samples_per_pixel), first, second, exact, camera)


def _render(own: Render, light: str, samples: int) -> Render:
    return Render.model_validate(own.model_dump() | {"light": light, "samples_per_pixel": samples})


def _flows(
    name: str,
    setting: tuple[str, int],
    first: Sequence[tuple[Image, Image]],
    second: Sequence[tuple[Image, Image]],
    exact: Truth,
    camera: Camera,
) -> Iterator[FlowRow]:
    """Both methods on pairs of (picture, what it is held against) with the same camera noise."""
    for method, measure in METHODS.items():
        values = []
        for number, (ones, others) in enumerate(zip(first, second, strict=True)):
            for draw in range(NOISE_DRAWS):
                flow, aim = (
                    measure(_photograph(one, camera, (0, number, draw)), _photograph(other, camera, (1, number, draw)))
                    for one, other in zip(ones, others, strict=True)
                )
                apart = np.linalg.norm(flow - aim, axis=2)[exact.counts]
                change = exact.error_px(flow) - exact.error_px(aim)
                typical = exact.typical_px(flow) - exact.typical_px(aim)
                values.append((change, typical, float(apart.mean()), float(np.median(apart))))
        yield FlowRow(name, *setting, method, *(float(value) for value in np.mean(values, axis=0)))


def _photograph(radiance: Image, camera: Camera, number: tuple[int, int, int]) -> Grey:
    """What a flow method gets: (H, W) uint8, grey."""
    values = camera_image(radiance, camera, np.random.default_rng([_SEEDS, *number])).astype(np.float64)
    grey = values @ np.array([0.299, 0.587, 0.114])  # ITU-R BT.601
    return np.asarray(np.round(grey if camera.bit_depth == 8 else grey / 257), dtype=np.uint8)
