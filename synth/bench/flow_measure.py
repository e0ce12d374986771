"""Error and time of ways to make flow, against the derivation that `synth verify` has.

That shares no code with tracing: refraction by Fermat's principle, OpenCV's lens model, and a root search over the
projected triangles, in float64 (`synth.verify.sheet`). Errors are of all pixels that see gel in either image, both
directions together, whether the point is visible in the other image or not.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from synth.arrays import FloatArray
from synth.bench.flow_methods import SHIPPED, Motion, is_inside, methods
from synth.bench.render_measure import Say
from synth.bench.render_subject import View as Subject
from synth.verify.camera import ForwardCamera
from synth.verify.motion import check_motion, derive
from synth.verify.sheet import Sheet

REPEATS = 5


@dataclass(frozen=True)
class Row:
    """One way on one pair.

    Attributes:
        scene, family, method: names.
        mean_px, p99_px, max_px: of the distance from the independent derivation.
        mask_px: pixels whose visibility differs.
        ms: processor time of both directions, median.
    """

    scene: str
    family: str
    method: str
    mean_px: float
    p99_px: float
    max_px: float
    mask_px: int
    ms: float


@dataclass(frozen=True, eq=False)
class Pair:
    """The independent derivation of one pair.

    Attributes:
        motions: forward and backward.
        sheets: the two states.
        ms: processor time.
    """

    motions: tuple[Motion, Motion]
    sheets: tuple[Sheet, Sheet]
    ms: float

    @property
    def lengths(self) -> FloatArray:
        """(n,) px of all motions, where there is gel."""
        flows = np.concatenate([flow.reshape(-1, 2) for flow, _ in self.motions])
        lengths = np.linalg.norm(flows, axis=1)
        return np.asarray(lengths[np.isfinite(lengths)])

    @property
    def hidden(self) -> int:
        """Pixels whose point lies inside the other image and is hidden there."""
        return sum(int(np.count_nonzero(is_inside(flow) & ~visible)) for flow, visible in self.motions)


def truth(subject: Subject) -> Pair:
    """The independent derivation of the flow between the undeformed gel and the pressed one."""
    camera = subject.sensor.camera
    shape = camera.height, camera.width
    row, column = np.mgrid[: camera.height, : camera.width]
    places = np.column_stack([column.ravel(), row.ravel()]) + 0.5
    began = time.process_time()
    forward = ForwardCamera.of(subject.sensor)
    near, far = (
        Sheet(forward, subject.surface.triangles, state, camera.width, camera.height)
        for state in (subject.surface.material, subject.pressed)
    )
    unknown = np.full(places.shape, np.nan)  # no recorded flow to follow
    found = [derive(one, other, places, unknown) for one, other in ((near, far), (far, near))]
    ms = 1e3 * (time.process_time() - began)
    there, back = ((one.flow.reshape(*shape, 2), one.visible.reshape(shape)) for one in found)
    return Pair((there, back), (near, far), ms)


def measure(name: str, subject: Subject, pair: Pair, say: Say = lambda _: None) -> Iterator[Row]:
    """A row for each way.

    Args:
        name: of the scene.
        subject: sensor and press.
        pair: its derivation.
        say: told what was done.
    """
    first, second = subject.surface.material, subject.pressed
    for method in methods(subject):
        generate = method.make(subject)
        found = generate(first, second)  # compiles
        times = []
        for _ in range(REPEATS):
            one, other = first.copy(), second.copy()  # views know states by identity, and would keep what they showed
            began = time.process_time()
            generate(one, other)
            times.append(1e3 * (time.process_time() - began))
        row = Row(name, method.family, method.name, *_errors(found, pair), median(times))
        say(f"{name}: {method.name}: {row.ms:.0f} ms, {row.mean_px:.2g} px")
        yield row


def failures(subject: Subject, pair: Pair) -> list[str]:
    """What `synth verify` would object to in the shipped way's answer; silhouettes are excused as there."""
    shipped = next(method for method in methods(subject) if method.name == SHIPPED).make(subject)
    found = shipped(subject.surface.material, subject.pressed)
    failed = []
    for name, (flow, visible), (near, far) in zip(
        ("forward", "backward"), found, (pair.sheets, pair.sheets[::-1]), strict=True
    ):
        stored = flow.astype(np.float32), visible.astype(np.float32)
        failed += [
            f"{check.name}: {check.detail}" for check in check_motion(name, near, far, *stored) if not check.passed
        ]
    return failed


def _errors(found: Sequence[Motion], pair: Pair) -> tuple[float, float, float, int]:
    """Mean, 99th percentile, maximum of the errors in px, and the number of pixels whose visibility differs."""
    distances, differing = [], 0
    for (flow, visible), (true, seen) in zip(found, pair.motions, strict=True):
        distances.append(np.linalg.norm(flow - true, axis=2).ravel())
        differing += int(np.count_nonzero(visible != seen))
    all_px = np.concatenate(distances)
    known = all_px[np.isfinite(all_px)]
    if not len(known):
        return float("nan"), float("nan"), float("nan"), differing
    return float(known.mean()), float(np.percentile(known, 99)), float(known.max()), differing
