"""How far are rendered images from the truth, for how much time, and what of it does optical flow notice?

render.csv: errors of the pressed gel's image against a path-traced reference, by variant, samples per pixel, path
depth, and without the window's refraction, which is another image ("rmse" is then the difference). render_flow.csv:
what render noise changes in the flow that OpenCV's DIS (medium) measures, with the camera's noise and without.
render_auto.csv: the samples that `samples_per_pixel = "auto"` picks for a scene's first sensors, and the noise that is
left.
Formulas: benchmarks/image_error.py, benchmarks/flow_change.py. Levels are of 255.
"""

from argparse import Namespace
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from benchmarks.capsule_surface import surface_at_rest
from benchmarks.flow_change import Images, Truth, changes
from benchmarks.image_error import LEVELS, Halves, camera_noise, errors, reference_noise, rendered
from benchmarks.pressed_gel import Press, main_camera, press, without_window
from benchmarks.rows import Row, arguments, machine, measure, plot, show
from gelflow.baselines.registry import named_methods
from synth.cli_options import DEFAULT_SCENE
from synth.errors import InputError
from synth.planning import job_variant
from synth.render.camera_image import render_noise
from synth.render.pattern import albedo
from synth.render.renderer import Renderer, full_grid
from synth.render.variant import Device, Variant, choose_variant
from synth.sampling import draw, stream
from synth.scene import Render
from synth.scene.template import Template, load_scene

SAMPLES = (1, 4, 16, 36, 64, 144, 256, 576, 1024)
FEW_SAMPLES, DEPTH_SAMPLES, FLOW_SAMPLES = (1, 36), 144, (1, 4, 16, 36, 64, 144)
"""Asked for: of variants but the fastest and of images without window, of path depths, and of flow."""
DEPTHS, DEEPEST = (2, 3, 4, 6), 8
REPEATS, SENSORS = 3, 3
FEWER_THAN_REFERENCE = 6
"""No image has more samples than the reference divided by this."""


def variants(device: Device, grey: bool) -> dict[str, Variant]:
    """The variants of Mitsuba that can be compared here, by name and the fastest first."""
    found = [choose_variant(device, grey), choose_variant("cpu", grey), choose_variant("cpu", False)]
    return {variant.name: variant for variant in found}


def settings(names: Sequence[str], lights: int, own_depth: int, reference: int) -> list[Row]:
    """Columns of all images: samples at the scene's depth and the deepest, depths, other variants, and no window.

    Args:
        names: of the variants, the fastest first.
        lights: that shine; samples are a multiple of their number.
        own_depth: the scene's path depth.
        reference: samples per pixel of the reference.
    """
    most = max(reference // FEWER_THAN_REFERENCE, full_grid(1, lights))

    def several(names: Iterable[str], window: bool, depths: Iterable[int], asked: Iterable[int]) -> list[tuple]:
        counts = [n for n in dict.fromkeys(full_grid(one, lights) for one in asked) if n <= most]
        return [(name, window, depth, n) for name in names for depth in depths for n in counts]

    found = several(names[:1], True, (own_depth, max(DEEPEST, own_depth)), SAMPLES)
    found += several(names[:1], True, DEPTHS, (DEPTH_SAMPLES,)) + several(names[1:], True, (own_depth,), FEW_SAMPLES)
    found += several(names, False, (own_depth,), FEW_SAMPLES)
    return [dict(zip(("variant", "window", "max_depth", "samples"), one, strict=True)) for one in dict.fromkeys(found)]


def others(images: Images) -> list[list[np.ndarray]]:
    """For each image the mean of the others of its state: the same image with less noise, and independent of it."""
    return [[np.mean([*state[:k], *state[k + 1 :]], axis=0) for k in range(len(state))] for state in images]


@dataclass(frozen=True, eq=False)
class Job:
    """What one run is about."""

    given: Namespace
    template: Template
    press: Press
    fastest: Variant

    @property
    def common(self) -> Row:
        """Columns of all tables."""
        return {"scene": self.given.scene, "seed": self.given.seed, "scale": self.given.scale}

    @property
    def lights(self) -> int:
        """Lights that shine; samples of path tracing are a multiple of their number."""
        return sum(light.power > 0 for light in self.press.scene.sensor.lights)

    @property
    def own_depth(self) -> int:
        """The scene's path depth."""
        return self.press.scene.render.max_depth


def image_table(job: Job) -> None:
    """Error against time."""
    known = variants(job.given.device, job.fastest.is_mono)
    columns = settings(list(known), job.lights, job.own_depth, job.given.reference)
    view = job.press.view(job.given.scale)
    camera = view.sensor.camera

    @cache
    def reference() -> Halves:
        half = _path_traced((job.given.reference + 1) // 2, max(DEEPEST, job.own_depth))
        renderer = view.renderer(job.fastest, half)
        return renderer.radiance(view.pressed, 1), renderer.radiance(view.pressed, 2)

    def image(case: Row) -> Row:
        seen = view if case["window"] else replace(view, sensor=without_window(view.sensor))
        renderer = seen.renderer(known[case["variant"]], _path_traced(case["samples"], case["max_depth"]))
        # Seeds of its own for every image: two with the same number of samples would start with the same rays.
        seed = 1000 * (1 + columns.index({name: case[name] for name in columns[0]}))
        images, times = rendered(renderer, view.pressed, range(seed, seed + REPEATS))
        row = {**times, **errors(images, reference(), camera)}
        row["reference_noise"] = reference_noise(reference(), camera)
        return {**row, "camera_noise": camera_noise(reference()[0], camera)}

    cases = [{**job.common, "reference": job.given.reference, **setting} for setting in columns]
    rows = measure(job.given.out / "render.csv", cases, image)
    timed = "seconds" if job.fastest.name.startswith("cuda") else "processor_s"
    shown = ["rmse", "noise", "systematic", "systematic_limit", "bias_percent", "bias_se_percent", "camera_noise"]
    show(rows, [*columns[0], timed, *shown], "Error of the image, levels of 255")
    lines = [{**row, "line": f"{row['variant']}, depth {row['max_depth']}"} for row in rows if row["window"]]
    plot(job.given.out / "render.png", lines, x=timed, y="rmse", group="line")


def flow_table(job: Job) -> None:
    """What DIS makes of render noise, on the scene's own image size."""
    view, seeds = job.press.view(), job.given.seeds
    samples = list(dict.fromkeys(full_grid(n, job.lights) for n in FLOW_SAMPLES))
    channels = 1 if job.fastest.is_mono else 3  # a grey camera has one noise, not the mean of three

    @cache
    def images(samples: int) -> Images:
        renderer, first = view.renderer(job.fastest, _path_traced(samples, job.own_depth)), 10**6 + 2 * seeds * samples
        return [
            [renderer.radiance(state, first + seeds * side + k)[:, :, :channels] for k in range(seeds)]
            for side, state in enumerate(view.states)
        ]

    def flow(case: Row) -> Row:
        quiet = {} if case["camera_noise"] else {"read_noise": 0.0, "shot_noise": 0.0}
        camera, (method,) = view.sensor.camera.model_copy(update=quiet), named_methods(["dis-medium"])
        return changes(images(case["samples"]), others(images(samples[-1])), camera, Truth.of(view), method)

    settings = [{"samples": n, "camera_noise": noise} for n in samples for noise in (False, True)]
    cases = [{**job.common, "seeds": seeds, **setting} for setting in settings]
    rows = measure(job.given.out / "render_flow.csv", cases, flow)
    shown = [f"{of}{what}" for of in ("", "median_") for what in ("error_px", "change_px", "change_se_px")]
    show(rows, ["camera_noise", "samples", *shown, "difference_px"], "Flow of DIS, px")
    plot(job.given.out / "render_flow.png", rows, x="samples", y="difference_px", group="camera_noise")


def auto_row(job: Job, number: int) -> Row:
    """What "auto" picks for one of a scene's sensors, undeformed, and what it and the scene's own samples leave."""
    template, seed = job.template, job.given.seed
    scene = draw(template, seed, number * template.corners[0].sampling.trajectories_per_sensor)
    sensor = main_camera(scene.sensor, job.given.scale)
    texture = albedo(sensor, stream(template, seed, "pattern", number), template.source.parent)
    surface = surface_at_rest(sensor.gel)
    row: Row = {}
    for name, samples in (("auto", "auto"), ("scene", scene.render.samples_per_pixel)):
        render = scene.render.model_copy(update={"samples_per_pixel": samples})
        renderer = Renderer(sensor, render, surface, texture, job.fastest)
        images, times = rendered(renderer, surface.material, (501, 502))  # other seeds than the pilots of "auto"
        noise = LEVELS * render_noise(images[0], images[1], sensor.camera)
        row |= {f"{name}_samples": renderer.samples_per_pixel, f"{name}_seconds": times["seconds"]}
        row |= {f"{name}_noise": noise, f"{name}_share": noise / camera_noise(images[0], sensor.camera)}
    return row


def auto_table(job: Job) -> None:
    """What "auto" picks."""
    cases = [{**job.common, "sensor": number} for number in range(SENSORS)]
    rows = measure(job.given.out / "render_auto.csv", cases, lambda case: auto_row(job, case["sensor"]))
    show(rows, ["sensor", *(name for name in rows[0] if "_" in name)], 'Samples per pixel, "auto" and the scene\'s')


def main(argv: list[str]) -> int:
    """Measure, or go on measuring."""
    parser = arguments("render", __doc__)
    parser.add_argument("--scene", default=DEFAULT_SCENE, help="name or TOML file")
    parser.add_argument("--scale", type=float, default=0.5, help="of the images in render.csv and render_auto.csv")
    parser.add_argument("--reference", type=int, default=4096, help="samples per pixel of the reference")
    parser.add_argument("--seeds", type=int, default=6, help="of each of the two states whose flow is measured")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--seed", type=int, default=0, help="of the press")
    given = parser.parse_args(argv)
    if given.seeds < 3:
        raise InputError(f"--seeds {given.seeds}: the standard error of the flow's change needs at least 3")
    template = load_scene(given.scene, ['render.light="path_traced"'])  # benchmarks/light.py has the other kind
    job = Job(given, template, press(template, given.seed), job_variant(template, given.device))
    print(machine())
    image_table(job)
    flow_table(job)
    auto_table(job)
    return 0


def _path_traced(samples: int, max_depth: int) -> Render:
    return Render(samples_per_pixel=samples, max_depth=max_depth, light="path_traced")
