"""How exact is the ground-truth flow, and what would simpler and faster methods give for the same deformed gel?

One pair of each scene, undeformed and pressed, both directions. Errors are distances from the derivation of
`synth verify`, which shares no code with tracing: refraction by Fermat's principle, OpenCV's lens model, a root search
over the projected triangles, in float64. They are taken over all pixels that see gel and get a value, whether the point
is visible in the other image or not; "mask_px" are pixels whose visibility there differs, missing values included. "ms"
is processor time of both directions, median of 5. Methods: benchmarks/flow_methods.py.
"""

import time
from collections.abc import Sequence
from functools import cache
from statistics import median

import numpy as np

from benchmarks.flow_methods import METHODS, SHIPPED, Motion
from benchmarks.pressed_gel import View, press
from benchmarks.rows import Row, arguments, machine, measure, plot, show
from synth.scene.template import load_scene
from synth.verify.camera import ForwardCamera
from synth.verify.motion import FLOW_TOLERANCE_PX, derive
from synth.verify.sheet import Sheet

SCENES = ("gelsight_mini", "tac3d", "densetact")
"""A flat pad seen straight, one seen by mirrors, which hide some of it, and a hemisphere seen by a fisheye lens."""
REPEATS = 5


def derived(view: View) -> tuple[Motion, Motion]:
    """The independent derivation of the motion from the undeformed to the pressed gel, and back."""
    camera = view.sensor.camera
    row, column = np.mgrid[: camera.height, : camera.width]
    places = np.column_stack([column.ravel(), row.ravel()]) + 0.5
    forward = ForwardCamera.of(view.sensor)
    near, far = (Sheet(forward, view.surface.triangles, state, camera.width, camera.height) for state in view.states)
    unknown = np.full(places.shape, np.nan)  # no recorded flow to follow
    found = [derive(one, other, places, unknown) for one, other in ((near, far), (far, near))]
    shape = camera.height, camera.width
    there, back = ((one.flow.reshape(*shape, 2), one.visible.reshape(shape)) for one in found)
    return there, back


def method_row(view: View, truth: Sequence[Motion], method: str) -> Row:
    """Error and time of one method."""
    generate = METHODS[method](view)
    found, times = generate(*view.states), []  # the first call compiles
    for _ in range(REPEATS):
        first, second = (
            state.copy() for state in view.states
        )  # tracers know states by identity, and keep what is seen
        began = time.process_time()
        generate(first, second)
        times.append(1e3 * (time.process_time() - began))
    distances = np.concatenate(
        [np.linalg.norm(flow - true, axis=2).ravel() for (flow, _), (true, _) in zip(found, truth, strict=True)]
    )
    known = distances[np.isfinite(distances)]
    return {
        "mean_px": float(known.mean()),
        "p99_px": float(np.percentile(known, 99)),
        "max_px": float(known.max()),
        "mask_px": sum(int(np.count_nonzero(one != other)) for (_, one), (_, other) in zip(found, truth, strict=True)),
        "ms": median(times),
    }


def main(argv: list[str]) -> int:
    """Measure, or go on measuring; 1 if the error of the shipped flow is beyond what `synth verify` allows."""
    parser = arguments("flow", __doc__)
    parser.add_argument("scenes", nargs="*", default=list(SCENES), help="names or TOML files")
    parser.add_argument("--seed", type=int, default=0, help="of the presses")
    given = parser.parse_args(argv)

    @cache
    def pair(scene: str) -> tuple[View, tuple[Motion, Motion]]:
        view = press(load_scene(scene), given.seed).view()
        return view, derived(view)

    scenes = list(dict.fromkeys(given.scenes))
    cases = [{"scene": scene, "seed": given.seed, "method": method} for scene in scenes for method in METHODS]
    rows = measure(given.out / "flow.csv", cases, lambda case: method_row(*pair(case["scene"]), case["method"]))
    print(machine())
    show(rows, ["scene", "method", "mean_px", "p99_px", "max_px", "mask_px", "ms"], "Error of the flow")
    plot(given.out / "flow.png", rows, x="ms", y="mean_px", group="method", panel="scene")
    return int(any(row["max_px"] > FLOW_TOLERANCE_PX for row in rows if row["method"] == SHIPPED))
