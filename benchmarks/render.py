"""How far are rendered images from the truth, for how much time, and what of it does optical flow notice?

render.csv: errors of the pressed gel's image against a path-traced reference, by variant, samples per pixel, path
depth, and without the window's refraction, which is another image ("rmse" is then the difference). render_flow.csv:
what render noise changes in the flow that OpenCV's DIS (medium) measures, with the camera's noise and without.
render_auto.csv: the samples that `samples_per_pixel = "auto"` picks for a scene's first sensors, and the noise that is
left.
Formulas: benchmarks/image_error.py, benchmarks/flow_change.py. Levels are of 255.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.flow_change import Images, Truth, changes
from benchmarks.image_error import LEVELS, Halves, camera_noise, errors, reference_noise, rendered
from benchmarks.pressed_gel import View, press, resized, without_window
from benchmarks.rows import Row, arguments, machine, measure, plot, show
from gelflow.baselines.registry import named_methods
from synth.cli_options import DEFAULT_SCENE
from synth.errors import InputError
from synth.generate import job_variant
from synth.mesh import rest_surface
from synth.render.pattern import albedo
from synth.render.renderer import Renderer, full_grid
from synth.render.sample_count import render_noise
from synth.render.variant import Device, Variant, choose_variant, cpu_variant, llvm_version
from synth.sampling import draw, stream
from synth.scene import Render
from synth.template import Template, load_scene

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
    return {variant.name: variant for variant in [*found, cpu_variant((), llvm_version, "rgb")]}


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


def image_row(view: View, setting: Row, variant: Variant, reference: Halves, seed: int) -> Row:
    """Errors and time of the pressed gel's image with one of `settings`."""
    if not setting["window"]:
        view = replace(view, sensor=without_window(view.sensor))
    renderer = view.renderer(variant, _path_traced(setting["samples"], setting["max_depth"]))
    images, times = rendered(renderer, view.pressed, range(seed, seed + REPEATS))
    return {**times, **errors(images, reference, view.sensor.camera)}


def others(images: Images) -> list[list[np.ndarray]]:
    """For each image the mean of the others of its state: the same image with less noise, and independent of it."""
    sums = [np.sum(state, axis=0, dtype=np.float64) for state in images]
    return [
        [((total - one) / (len(state) - 1)).astype(np.float32) for one in state]
        for total, state in zip(sums, images, strict=True)
    ]


def auto_row(template: Template, seed: int, number: int, scale: float, variant: Variant) -> Row:
    """What "auto" picks for one of a scene's sensors, undeformed, and what it and the scene's own samples leave."""
    scene = draw(template, seed, number * template.corners[0].sampling.trajectories_per_sensor)
    camera = scene.sensor.camera
    size = (round(scale * camera.width), round(scale * camera.height))
    sensor = resized(scene.sensor.model_copy(update={"further_cameras": ()}), size)
    texture = albedo(sensor, stream(template, seed, "pattern", number), template.source.parent)
    surface = rest_surface(sensor.gel)
    row: Row = {}
    for name, samples in (("auto", "auto"), ("scene", scene.render.samples_per_pixel)):
        render = scene.render.model_copy(update={"samples_per_pixel": samples})
        renderer = Renderer(sensor, render, surface, texture, variant)
        images, times = rendered(renderer, surface.material, (501, 502))  # other seeds than the pilots of "auto"
        noise = LEVELS * render_noise(images[0], images[1], sensor.camera)
        row |= {f"{name}_samples": renderer.samples_per_pixel, f"{name}_seconds": times["seconds"]}
        row |= {f"{name}_noise": noise, f"{name}_share": noise / camera_noise(images[0], sensor.camera)}
    return row


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
    fastest = job_variant(template, given.device)
    known = variants(given.device, fastest.is_mono)
    pressed = press(template, given.seed)
    view, full, own_depth = pressed.view(given.scale), pressed.view(), pressed.scene.render.max_depth
    lights = sum(light.power > 0 for light in view.sensor.lights)
    common = {"scene": given.scene, "seed": given.seed, "scale": given.scale}

    @cache
    def reference() -> Halves:
        half = _path_traced((given.reference + 1) // 2, max(DEEPEST, own_depth))
        renderer = view.renderer(fastest, half)
        return renderer.radiance(view.pressed, 1), renderer.radiance(view.pressed, 2)

    columns = settings(list(known), lights, own_depth, given.reference)
    # Seeds of its own for every image: two with the same number of samples would start with the same rays.
    seeds = {tuple(setting.values()): 1000 * number for number, setting in enumerate(columns, 1)}

    def image(case: Row) -> Row:
        setting = {name: case[name] for name in columns[0]}
        row = image_row(view, setting, known[case["variant"]], reference(), seeds[tuple(setting.values())])
        camera = camera_noise(reference()[0], view.sensor.camera)
        return {**row, "reference_noise": reference_noise(reference(), view.sensor.camera), "camera_noise": camera}

    images = [{**common, "reference": given.reference, **setting} for setting in columns]
    rows = measure(given.out / "render.csv", images, image)

    flow_samples = list(dict.fromkeys(full_grid(n, lights) for n in FLOW_SAMPLES))
    channels = 1 if fastest.is_mono else 3  # a grey camera has one noise, not the mean of three

    @cache
    def pictures(samples: int) -> Images:
        renderer, first = full.renderer(fastest, _path_traced(samples, own_depth)), 10**6 + 2 * given.seeds * samples
        return [
            [renderer.radiance(state, first + given.seeds * side + k)[:, :, :channels] for k in range(given.seeds)]
            for side, state in enumerate(full.states)
        ]

    def flow(case: Row) -> Row:
        quiet = {} if case["camera_noise"] else {"read_noise": 0.0, "shot_noise": 0.0}
        camera, (method,) = full.sensor.camera.model_copy(update=quiet), named_methods(["dis-medium"])
        return changes(pictures(case["samples"]), others(pictures(flow_samples[-1])), camera, Truth.of(full), method)

    pairs = [
        {**common, "seeds": given.seeds, "samples": n, "camera_noise": noise}
        for n in flow_samples
        for noise in (False, True)
    ]
    flows = measure(given.out / "render_flow.csv", pairs, flow)
    sensors = [{**common, "sensor": number} for number in range(SENSORS)]
    autos = measure(
        given.out / "render_auto.csv",
        sensors,
        lambda case: auto_row(template, given.seed, case["sensor"], given.scale, fastest),
    )

    print(machine())
    timed = "seconds" if fastest.name.startswith("cuda") else "processor_s"
    shown = ["rmse", "noise", "systematic", "systematic_limit", "bias_percent", "bias_se_percent"]
    show(rows, [*columns[0], timed, *shown, "camera_noise"], "Error of the image, levels of 255")
    changed = [f"{of}{what}" for of in ("", "median_") for what in ("error_px", "change_px", "change_se_px")]
    show(flows, ["camera_noise", "samples", *changed, "difference_px"], "Flow of DIS, px")
    show(autos, ["sensor", *(name for name in autos[0] if "_" in name)], 'Samples per pixel, "auto" and the scene\'s')
    lines = [{**row, "line": f"{row['variant']}, depth {row['max_depth']}"} for row in rows if row["window"]]
    plot(given.out / "render.png", lines, x=timed, y="rmse", group="line")
    plot(given.out / "render_flow.png", flows, x="samples", y="difference_px", group="camera_noise")
    return 0


def _path_traced(samples: int, max_depth: int) -> Render:
    return Render(samples_per_pixel=samples, max_depth=max_depth, light="path_traced")
