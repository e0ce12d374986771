"""Does separated light give the path tracer's image, in less time, and the same measured flow?

light.csv: errors of the image, undeformed and pressed, against a path-traced reference; "share" is the error over
the camera's own noise, "path_tracing_s" the processor time in which path tracing would come to the same noise, by the
law noise² ~ 1 / time. light_flow.csv: how the flow that DIS (medium) and Farnebäck measure on the pair changes against
that on the reference's; light "reference" compares the reference's own halves, the least that can be told.
Formulas: benchmarks/image_error.py, benchmarks/flow_change.py. Levels are of 255.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from benchmarks.flow_change import Truth, changes
from benchmarks.image_error import Halves, camera_noise, errors, rendered
from benchmarks.pressed_gel import View, press
from benchmarks.rows import Row, arguments, machine, measure, plot, show
from gelflow.baselines.registry import named_methods
from synth.arrays import Image
from synth.cli_options import DEFAULT_SCENE
from synth.planning import job_variant
from synth.render.renderer import Renderer, full_grid
from synth.render.variant import Variant
from synth.scene import Render
from synth.scene.template import load_scene

STATES = ("undeformed", "pressed")
SEPARATED_SAMPLES = (9, 16, 36)
PATH_TRACED_SAMPLES = 36
"""Where the scene's own number is "auto"."""
METHODS = ("dis-medium", "farneback")
REPEATS = 3
SCALE = 0.5
"""Of the image."""


def main(argv: list[str]) -> int:
    """Measure, or go on measuring."""
    parser = arguments("light", __doc__)
    parser.add_argument("scenes", nargs="*", default=[DEFAULT_SCENE], help="names or TOML files")
    parser.add_argument("--reference", type=int, default=4096, help="samples per pixel of the reference")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--seed", type=int, default=0, help="of the presses")
    given = parser.parse_args(argv)
    rows: list[Row] = []
    flows: list[Row] = []
    for scene in dict.fromkeys(given.scenes):
        template = load_scene(scene)
        pressed = press(template, given.seed)
        common = {"scene": scene, "seed": given.seed, "reference": given.reference}
        image, flow = _measures(
            pressed.view(SCALE), job_variant(template, given.device), pressed.scene.render, given.reference
        )
        own = pressed.scene.render.samples_per_pixel
        count = sum(light.power > 0 for light in pressed.scene.sensor.lights)
        lights = [("path_traced", full_grid(PATH_TRACED_SAMPLES if own == "auto" else own, count))]
        lights += [("separated", n) for n in SEPARATED_SAMPLES]
        settings = [{**common, "light": light, "samples": n} for light, n in lights]
        cases = [{**setting, "state": state} for setting in settings for state in STATES]
        rows += measure(given.out / "light.csv", cases, image)
        settings.append({**common, "light": "reference", "samples": given.reference // 2})
        cases = [{**setting, "method": method} for setting in settings for method in METHODS]
        flows += measure(given.out / "light_flow.csv", cases, flow)
    print(machine())
    traced = {(row["scene"], row["state"]): row for row in rows if row["light"] == "path_traced"}
    for row in rows:
        alike = traced[row["scene"], row["state"]]
        row["path_tracing_s"] = alike["processor_s"] * (alike["noise"] / max(row["noise"], 1e-9)) ** 2
    shown = ["rmse", "noise", "systematic", "systematic_limit", "share", "path_tracing_s"]
    show(rows, ["scene", "state", "light", "samples", "processor_s", *shown], "Error of the image, levels of 255")
    changed = [f"{of}{what}" for of in ("", "median_") for what in ("change_px", "change_se_px", "difference_px")]
    show(flows, ["scene", "method", "light", "samples", *changed], "Change of the measured flow, px")
    lines = [{**row, "line": f"{row['light']}, {row['state']}"} for row in rows]
    plot(given.out / "light.png", lines, x="processor_s", y="rmse", group="line", panel="scene")
    return 0


def _measures(
    view: View, variant: Variant, own: Render, reference: int
) -> tuple[Callable[[Row], Row], Callable[[Row], Row]]:
    """What measures an image's and a pair's case of one scene; images are rendered once for both."""
    camera = view.sensor.camera

    def renderer(light: str, samples: int) -> Renderer:
        render = own.model_dump() | {"light": light, "samples_per_pixel": samples}
        return view.renderer(variant, Render.model_validate(render))

    @cache
    def halves() -> tuple[Halves, ...]:
        one = renderer("path_traced", reference // 2)
        return tuple((one.radiance(state, 1), one.radiance(state, 2)) for state in view.states)

    @cache
    def frames(light: str, samples: int) -> list[tuple[list[Image], dict[str, float]]]:
        one = renderer(light, samples)
        return [rendered(one, state, range(5000, 5000 + REPEATS)) for state in view.states]

    def image(case: Row) -> Row:
        side = STATES.index(case["state"])
        (images, times), compared = frames(case["light"], case["samples"])[side], halves()[side]
        row = {**times, **errors(images, compared, camera)}
        return {**row, "share": row["rmse"] / camera_noise(compared[0], camera)}

    def flow(case: Row) -> Row:
        (method,) = named_methods([case["method"]])
        if case["light"] == "reference":
            images, compared = ([[pair[k]] for pair in halves()] for k in (0, 1))
        else:
            images = [state for state, _ in frames(case["light"], case["samples"])]
            compared = [REPEATS * [np.asarray((pair[0] + pair[1]) / 2, dtype=np.float32)] for pair in halves()]
        return changes(images, compared, camera, Truth.of(view), method)

    return image, flow
