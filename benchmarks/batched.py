"""How many presses a second does the batched solver make, where does the time go, and how wrong are its surfaces?

    python -m benchmarks batched --batch 512 2048 --seconds 36        on a GPU
    python -m benchmarks batched --errors 12 --device cpu             surface errors instead

A press is a ball of 2 to 6 mm radius (--radii) at a random place of a pad of 20 x 15 x 4 mm, pressed to half its
thickness with friction, and one state recorded. Trajectories that end make room for others, as in `synth generate`, and
the rate is counted from when as many have ended as run at once; results travel to the host within that time. With
--errors N the first N presses are compared with a mesh refined around each: relative L2 error of the contact face's
displacement, and of the force. That is done by the solver for one sample, which gives what the batched one does.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache, partial
from itertools import cycle, islice, pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
import warp as wp

from benchmarks.press import PAD_MM, ball_scene, face_displacement, face_grid
from benchmarks.rows import Row, arguments, machine, measure, show
from synth.errors import InputError
from synth.mesh import Counts, Focus, PadMesh, graded_box
from synth.press.press import Press
from synth.press.resolution import graded_mesh
from synth.scene import Scene
from synth.simulate import simulate
from synth.simulate.batched.gpu import dense
from synth.simulate.batched.krylov import RUNNING, WAITING
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.batched.run import OPTIONS, Run, simulate_presses
from synth.simulate.batched.solver import INNER_ITERATIONS, BatchedSolver

PLACES_MM = (6.0, 4.0)
"""Half width of the rectangle that the balls' centres are drawn from."""
DRAWS = 2048
"""Different presses; they are gone through again and again, so that drawing them takes no part of the time."""
PROFILED_CYCLES = 20
POINTS = face_grid(PAD_MM, (81, 61))


def random_ball(rng: np.random.Generator, case: Row) -> Scene:
    """A ball at a random place, with friction, that is dragged in a random direction once it is down."""
    angle = rng.uniform(0, 2 * np.pi)
    radius, friction = float(rng.uniform(case["smallest_mm"], case["largest_mm"])), float(rng.uniform(0.3, 1.0))
    place = [float(rng.uniform(-half, half)) for half in PLACES_MM]
    drag = [float(case["drag_mm"] * np.cos(angle)), float(case["drag_mm"] * np.sin(angle))]
    motion = {"depth_mm": case["depth_mm"], "shear_mm": drag, "position_mm": place, "steps": case["steps"]}
    scene = ball_scene(radius, friction, motion)
    step = {} if case["step_mm"] is None else {"max_step_mm": case["step_mm"]}
    return scene.model_copy(update={"numerics": scene.numerics.model_copy(update=step)})


def nth_ball(number: int, case: Row) -> Scene:
    """One of the balls that every measurement begins with."""
    rng = np.random.default_rng(0)
    return [random_ball(rng, case) for _ in range(number + 1)][-1]


def mesh_of(case: Row) -> PadMesh:
    """A mesh for presses anywhere: even along x and y, with elements that grow through the thickness."""
    x, y, z = map(int, case["cells"].split("x"))
    counts = Counts((x - 2, y - 2), (1, 1), z, growth=case["growth"])
    return graded_box(PAD_MM, Focus((0.0, 0.0), (PAD_MM[0] / 2, PAD_MM[1] / 2)), counts)


@cache
def pad_of(cells: str, growth: float, device: str) -> Pad:
    """The pad, prepared once for all rates."""
    mesh = mesh_of({"cells": cells, "growth": growth})
    return prepare(ball_scene(4.0, 0.5, {"depth_mm": 1.0}), mesh, device)


def rate(case: Row, device: str) -> Row:
    """Presses per second, and what a cycle's time goes into: `ms_*` of each part, `krylov_busy` the share of the places
    for Krylov iterations that are used.
    """
    pad = pad_of(case["cells"], case["growth"], device)
    rng = np.random.default_rng(0)
    scenes = [random_ball(rng, case) for _ in range(max(DRAWS, case["batch"]))]
    options = replace(OPTIONS, forcing=case["forcing"], relaxed_tolerance=case["relaxed"], closer=case["closer"])
    presses = enumerate(cycle([(Press.of(scene, pad.space.mesh), None) for scene in scenes]))
    list(simulate_presses([press for _, press in islice(presses, 1)], pad, 1, options))  # compiles the kernels
    began = time.perf_counter()
    ends: list[float] = []
    complete = iterations = 0
    for _, result in simulate_presses((press for _, press in presses), pad, case["batch"], options):
        ends.append(time.perf_counter() - began)
        complete += result.status == "complete"
        iterations += sum(state.newton_iterations for state in result.states)
        if ends[-1] > case["seconds"]:
            break
    return {
        "unknowns": len(pad.free),
        "presses": len(ends),
        "complete": complete,
        "presses_per_s": round(steady(ends, case["batch"]), 2),
        "newton_per_press": round(iterations / len(ends), 2),
        **profile(Run(deque(islice(presses, case["batch"])), presses, case["batch"], pad, options), device),
    }


def steady(ends: Sequence[float], batch: int) -> float:
    """Presses per second from the end of the first batch on, or of half of a run that was too short for that."""
    first = min(batch, len(ends) // 2)
    return (len(ends) - first) / (ends[-1] - ends[first - 1]) if first else len(ends) / ends[-1]


def profile(run: Run, device: str) -> Row:
    """What cycles of a run spend on each part of the solver, ms a cycle, after some that are not counted."""
    for _ in range(PROFILED_CYCLES):
        list(run.turn())
    krylov = run.solver.krylov
    clock = Events(device) if wp.get_device(device).is_cuda else Clock()
    parts: dict[str, float] = {}
    used = 0
    with timed(run.solver, clock):
        for _ in range(PROFILED_CYCLES):
            before = np.where(krylov.running.numpy() == RUNNING, krylov.k.numpy(), 0)
            clock.start()
            list(run.turn())
            for part, ms in clock.stop():
                parts[part] = parts.get(part, 0.0) + ms / PROFILED_CYCLES
            used += int(np.where(krylov.running.numpy() != WAITING, krylov.k.numpy() - before, 0).sum())
    busy = used / (PROFILED_CYCLES * INNER_ITERATIONS * run.solver.batch)
    return {"krylov_busy": round(busy, 3), **{f"ms_{part}": round(ms, 4) for part, ms in parts.items()}}


@contextmanager
def timed(solver: BatchedSolver, clock: "Clock") -> Iterator[None]:
    """A clock times the parts of the solver's cycles, which are then launched kernel by kernel, not as a graph."""
    parts: list[tuple[str, Callable[[], None], str]] = [
        ("_solve_and_evaluate", solver._launch_all, "krylov"),
        ("_linearise", solver._linearise, "tangent"),
        ("_precondition", solver._precondition, "preconditioner"),
        ("_multiply", solver._multiply, "product"),
        ("_evaluate", solver._evaluate, "residual"),
    ]
    with ExitStack() as patched:
        for name, method, part in parts:
            patched.enter_context(patch.object(solver, name, clock.within(part)(method)))
        yield


class Clock:
    """Times of the parts of a cycle on the CPU, where a launch ends when the kernel does."""

    def start(self) -> None:
        """Begin; what is in no other part is `stepping`."""
        self._part = "stepping"
        self._marks: list[tuple[str, Any]] = [("", self._now())]

    @contextmanager
    def within(self, part: str) -> Iterator[None]:
        """A part that may lie within another one, which goes on behind it."""
        outer = self._part
        self._mark()
        self._part = part
        yield
        self._mark()
        self._part = outer

    def _mark(self) -> None:
        self._marks.append((self._part, self._now()))

    def stop(self) -> list[tuple[str, float]]:
        """Part and ms of each mark."""
        return [(part, self._between(last, this)) for (_, last), (part, this) in pairwise(self._marks)]

    def _now(self) -> Any:
        return time.perf_counter()

    def _between(self, last: Any, this: Any) -> float:
        return 1e3 * float(this - last)


class Events(Clock):
    """The same on CUDA, by events in the stream.

    The GPU is kept busy by other work until the host has queued the whole cycle, so that no time between two events is
    the host's.
    """

    AHEAD_MS, SIZE = 40.0, 4096

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._dense = dense(device)
        matrix = (self.SIZE, self.SIZE)
        self._a, self._b, self._c = (wp.zeros(matrix, dtype=wp.float32, device=device) for _ in range(3))
        self._all = wp.ones(self.SIZE, dtype=wp.int32, device=device)
        self._times = 1
        for _ in range(2):  # the first takes longer
            first = self._now()
            self._be_busy()
            last = self._now()
            wp.synchronize_device(self._device)
        self._times = 1 + int(self.AHEAD_MS / self._between(first, last))

    def start(self) -> None:
        """Begin."""
        self._be_busy()
        super().start()

    def stop(self) -> list[tuple[str, float]]:
        """Part and ms of each mark."""
        wp.synchronize_device(self._device)
        return super().stop()

    def _now(self) -> Any:
        return self._device.stream.record_event(wp.Event(self._device, enable_timing=True))

    def _between(self, last: Any, this: Any) -> float:
        return float(wp.get_event_elapsed_time(last, this))

    def _be_busy(self) -> None:
        for _ in range(self._times):
            self._dense.product(self._a, self._b, self._c, self._all)


def reference_mesh(scene: Scene, across: int) -> PadMesh:
    """A mesh with so many elements across the square that holds a ball's contact."""
    radius, depth = scene.contact.indenter.model_dump()["radius_mm"], scene.motion.depth_mm
    reach = float(np.sqrt(max(2 * radius * depth - depth**2, 0.9 * radius**2)))
    x, y = scene.motion.position_mm
    return graded_mesh(scene.sensor.gel, Focus((x, y), (reach, reach)), across)[0]


def surface_error(case: Row) -> Row:
    """The error of one press on the case's mesh; the reference takes the scenes' own load steps."""
    scene, plain = (nth_ball(case["press"], {**case, "step_mm": step}) for step in (case["step_mm"], None))
    found = simulate(scene, mesh_of(case), options=replace(OPTIONS, relaxed_tolerance=case["relaxed"]))
    truth = simulate(plain, reference_mesh(scene, case["reference_across"]))
    row: Row = {
        "radius_mm": round(scene.contact.indenter.model_dump()["radius_mm"], 3),
        "status": found.status,
        "reference_status": truth.status,
    }
    if found.status == truth.status == "complete":
        last = len(truth.states) - 1
        u, r = (face_displacement(each, POINTS, [last]) for each in (found, truth))
        row["surface_error_percent"] = 100 * float(np.linalg.norm(u - r) / np.linalg.norm(r))
        row["force_error_percent"] = 100 * float(found.states[-1].force_n[2] / truth.states[-1].force_n[2] - 1)
    return row


def main(argv: list[str]) -> int:
    """Run the command line; 1 if a press of --errors did not complete."""
    parser = arguments("batched", __doc__)
    parser.add_argument("--device", default="cuda", help="default: cuda")
    parser.add_argument("--batch", type=int, nargs="+", default=[512], help="presses at once; default: 512")
    parser.add_argument("--runs", type=int, default=1, help="of each batch size")
    parser.add_argument("--seconds", type=float, default=36.0, help="of each run; default: 36")
    parser.add_argument("--cells", type=int, nargs=3, default=[16, 12, 2], help="elements along x, y and z")
    parser.add_argument("--growth", type=float, default=2.5, help="of elements through the thickness")
    parser.add_argument("--depth", type=float, default=2.0, help="mm")
    parser.add_argument("--drag", type=float, default=0.0, help="mm")
    parser.add_argument("--steps", type=int, default=1, help="recorded states")
    parser.add_argument("--radii", type=float, nargs=2, default=[2.0, 6.0], help="mm; of the balls")
    parser.add_argument("--forcing", type=float, default=OPTIONS.forcing, help="relative residual of linear solves")
    parser.add_argument("--relaxed", type=float, default=OPTIONS.relaxed_tolerance, help="of intermediate steps")
    parser.add_argument("--closer", type=float, default=OPTIONS.closer, help="tolerance of passes over the scene's")
    parser.add_argument("--step", type=float, help="mm; longest load step, default as in scenes")
    parser.add_argument("--errors", type=int, metavar="N", help="instead: surface errors of the first N presses")
    parser.add_argument("--across", type=int, default=10, help="elements across a contact in the reference")
    given = parser.parse_args(argv)
    if any(cells % 2 or cells < 4 for cells in given.cells[:2]):
        raise InputError(f"--cells {given.cells}: along x and y give even numbers of at least 4")
    press = {"cells": "x".join(map(str, given.cells)), "growth": given.growth, "depth_mm": given.depth}
    press |= {"drag_mm": given.drag, "steps": given.steps, "step_mm": given.step, "relaxed": given.relaxed}
    press |= {"smallest_mm": given.radii[0], "largest_mm": given.radii[1]}
    print(machine())
    if given.errors is not None:
        cases = [{**press, "reference_across": given.across, "press": number} for number in range(given.errors)]
        rows = measure(given.out / "batched_errors.csv", cases, surface_error)
        show(rows, ["press", "radius_mm", "surface_error_percent", "force_error_percent", "status"], press["cells"])
        return 0 if all("surface_error_percent" in row for row in rows) else 1
    name = wp.get_device(given.device).name
    press |= {"forcing": given.forcing, "closer": given.closer, "seconds": given.seconds}
    cases = [
        {"processor": name, **press, "batch": batch, "run": run} for batch in given.batch for run in range(given.runs)
    ]
    rows = measure(given.out / "batched.csv", cases, partial(rate, device=given.device))
    columns = ["batch", "run", "presses_per_s", "newton_per_press", "presses", "complete"]
    show(rows, columns, f"{name}, {press['cells']} cells")
    parts = [key for key in rows[0] if key.startswith("ms_")]
    show(rows, ["batch", "run", *parts, "krylov_busy"], "ms a cycle, by part")
    return 0
