"""Presses per second of the batched simulation, and what a cycle's time goes into.

    python -m synth.bench.batched --batch 512 --seconds 60

prints one JSON line per batch size; with --table also what each kernel takes of a cycle. A press is a ball of 2 to 6 mm
radius at a random place of a 20 x 15 x 4 mm pad, pressed to half its thickness with friction, every step converged as
in `synth generate`, and one state recorded and corrected. Bodies that begin and end are counted as they do in
production: slots are refilled, and the rate is counted from when as many have ended as there are slots. Results travel
to the host within that time.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle, pairwise
from typing import Any

import numpy as np
import warp as wp

from synth.mesh import Counts, Focus, PadMesh, graded_box
from synth.scene import Scene
from synth.simulate.batched.gemm import dense
from synth.simulate.batched.krylov import RUNNING, WAITING
from synth.simulate.batched.machine import INNER
from synth.simulate.batched.many import jobs_of
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.batched.run import Run
from synth.simulate.driver import STANDARD

SIZE_MM = (20.0, 15.0, 4.0)
PLACES_MM = (6.0, 4.0)
"""Half width of the rectangle that the balls' centres are drawn from."""
PROFILED_CYCLES = 20
DRAWS = 2048
"""Different presses; they are gone through again and again, so that drawing them takes no part of the time."""


def ball_scene(rng: np.random.Generator, depth_mm: float, drag_mm: float, steps: int) -> Scene:
    """A ball at a random place, with friction, that is dragged by drag_mm in a random direction once it is down."""
    angle = rng.uniform(0, 2 * np.pi)
    light = {"position_mm": [0, 0, 0.1], "size_mm": [1, 1], "color": [1, 1, 1], "power": 1}
    camera = {"width": 16, "height": 16, "fx": 9, "fy": 9, "cx": 8, "cy": 8, "position_mm": [0, 0, 90]}
    return Scene.model_validate(
        {
            "name": "bench",
            "sensor": {
                "gel": {"size_mm": SIZE_MM, "youngs_modulus_kpa": 200.0, "poisson_ratio": 0.4999},
                "pattern": {"kind": "none"},
                "lights": [light],
                "camera": camera,
            },
            "contact": {
                "indenter": {"shape": "sphere", "radius_mm": float(rng.uniform(2, 6))},
                "friction": float(rng.uniform(0.3, 1.0)),
            },
            "motion": {
                "depth_mm": depth_mm,
                "shear_mm": [float(drag_mm * np.cos(angle)), float(drag_mm * np.sin(angle))],
                "position_mm": [float(rng.uniform(-half, half)) for half in PLACES_MM],
                "steps": steps,
            },
        }
    )


def shared_mesh(
    across: Sequence[int],
    through: int,
    growth: float,
    zone_mm: Sequence[float] | None = None,
    outside: Sequence[int] = (1, 1),
) -> PadMesh:
    """A mesh for presses anywhere in PLACES_MM.

    Args:
        across: elements along x and y, in all or, with a zone, in it.
        through: the thickness.
        growth: per element through the thickness.
        zone_mm: half width of a rectangle beyond which elements grow; none: they are even.
        outside: elements on either side of it, along x and y.
    """
    if zone_mm is None:
        counts = Counts((across[0] - 2, across[1] - 2), (1, 1), through, growth=growth)
        return graded_box(SIZE_MM, Focus((0.0, 0.0), (SIZE_MM[0] / 2, SIZE_MM[1] / 2)), counts)
    counts = Counts((across[0], across[1]), (outside[0], outside[1]), through, growth=growth)
    return graded_box(SIZE_MM, Focus((0.0, 0.0), (zone_mm[0], zone_mm[1])), counts)


def measure(
    pad: Pad,
    batch: int,
    seconds: float,
    depth_mm: float = 2.0,
    drag_mm: float = 0.0,
    steps: int = 1,
    forcing: float = STANDARD.forcing,
    inner: int = INNER,
    loose: float = STANDARD.loose,
    step_mm: float | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """The rate on one pad; see the module's docstring.

    Args:
        pad: of SIZE_MM, on the device that is measured.
        batch: number of slots.
        seconds: after which no more results are waited for.
        depth_mm: of the press.
        drag_mm: sideways after it.
        steps: states that are recorded.
        forcing: relative residual that ends a linear solve, at most.
        inner: Krylov iterations of a cycle.
        loose: tolerance of Newton's method on the way to a recorded state.
        step_mm: longest load step; default the scenes'.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    draws = [ball_scene(rng, depth_mm, drag_mm, steps) for _ in range(max(DRAWS, batch))]
    began = time.perf_counter()
    order = cycle(range(len(draws)))
    driver = replace(STANDARD, forcing=forcing, loose=loose)
    numerics = draws[0].numerics.model_copy(update={} if step_mm is None else {"max_step_mm": step_mm})
    run = Run(jobs_of(draws, pad), pad, numerics, driver, None, batch, order, inner)
    for _ in range(2):  # with all slots empty: compiles the kernels and captures the graph
        run.advance()
    loaded = time.perf_counter() - began
    began = time.perf_counter()
    ends, complete, iterations = [], 0, 0
    for _, result in run:
        ends.append(time.perf_counter() - began)
        complete += result.status == "complete"
        iterations += sum(state.newton_iterations for state in result.states)
        if ends[-1] > seconds:
            break
    found: dict[str, Any] = {
        "processor": wp.get_device(pad.device).name,
        "batch": batch,
        "unknowns": len(pad.free),
        "elements": len(pad.mesh.tets),
        "presses": len(ends),
        "complete": complete,
        "seconds": round(ends[-1], 3),
        "presses_per_s": round(_steady(ends, batch), 2),
        "newton_per_press": round(iterations / len(ends), 2),
        "ms_per_cycle": round(1e3 * ends[-1] / run.cycles, 3),
        "cycles": run.cycles,
        "load_s": round(loaded, 2),
    }
    found["profile"] = _profile(run, pad.device)
    return found


def _steady(ends: Sequence[float], batch: int) -> float:
    """Rate from the end of the first batch's median press on; of everything where the run was too short for that."""
    first = min(batch, len(ends) // 2)
    return (len(ends) - first) / (ends[-1] - ends[first - 1]) if first else len(ends) / ends[-1]


def _profile(run: Run, device: str) -> dict[str, Any]:
    """What a cycle's time goes into.

    Returns:
        `parts` and `kernels`: ms a cycle; `launches` of a cycle; `ms_per_profiled_cycle`; `krylov_occupancy`: share of
        the places for Krylov iterations (slots times iterations of a cycle) that are used.
    """
    krylov, inner = run.machine.krylov, run.machine.inner
    clock = Events(device) if wp.get_device(device).is_cuda else Clock()
    kernels: dict[tuple[str, str], float] = {}
    launches = used = 0
    for _ in range(PROFILED_CYCLES):
        before = np.where(krylov.running.numpy() == RUNNING, krylov.k.numpy(), 0)
        clock.start()
        run.machine.watch = clock.mark
        run.machine.cycle(run.table)
        run.machine.watch = lambda part, kernel: None
        marks = clock.stop()
        launches += len(marks)
        for part, kernel, ms in marks:
            kernels[part, kernel] = kernels.get((part, kernel), 0.0) + ms
        used += int(np.where(krylov.running.numpy() != WAITING, krylov.k.numpy() - before, 0).sum())
    parts: dict[str, float] = {}
    for (part, _), ms in kernels.items():
        parts[part] = parts.get(part, 0.0) + ms
    return {
        "parts": _each_cycle(parts),
        "kernels": _each_cycle({f"{part}: {kernel}": ms for (part, kernel), ms in kernels.items()}),
        "launches": launches // PROFILED_CYCLES,
        "ms_per_profiled_cycle": round(sum(parts.values()) / PROFILED_CYCLES, 3),
        "krylov_occupancy": round(used / (PROFILED_CYCLES * inner * run.machine.batch), 3),
    }


def _each_cycle(times: dict[str, float]) -> dict[str, float]:
    """Of all profiled cycles -> of one, the largest first."""
    return {name: round(ms / PROFILED_CYCLES, 4) for name, ms in sorted(times.items(), key=lambda item: -item[1])}


class Clock:
    """Times between marks on the CPU, where a launch ends when the kernel does."""

    def start(self) -> None:
        """Begin."""
        self._marks: list[tuple[str, str, float]] = []
        self._last = time.perf_counter()

    def mark(self, part: str, kernel: str) -> None:
        """Note what ran since the last mark."""
        now = time.perf_counter()
        self._marks.append((part, kernel, 1e3 * (now - self._last)))
        self._last = now

    def stop(self) -> list[tuple[str, str, float]]:
        """Part, kernel and ms of each mark."""
        return self._marks


class Events:
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
            first = self._event()
            self._be_busy()
            last = self._event()
            wp.synchronize_device(self._device)
        self._times = 1 + int(self.AHEAD_MS / wp.get_event_elapsed_time(first, last))

    def _event(self) -> wp.Event:
        return self._device.stream.record_event(wp.Event(self._device, enable_timing=True))

    def _be_busy(self) -> None:
        for _ in range(self._times):
            self._dense.product(self._a, self._b, self._c, self._all)

    def start(self) -> None:
        """Begin."""
        self._be_busy()
        self._marks = [("", "", self._event())]

    def mark(self, part: str, kernel: str) -> None:
        """Note what was queued since the last mark."""
        self._marks.append((part, kernel, self._event()))

    def stop(self) -> list[tuple[str, str, float]]:
        """Part, kernel and ms of each mark."""
        wp.synchronize_device(self._device)
        pairs = pairwise(self._marks)
        return [(part, kernel, wp.get_event_elapsed_time(last, this)) for (_, _, last), (part, kernel, this) in pairs]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print a JSON line per batch size."""
    parser = argparse.ArgumentParser(description="presses/s of the batched simulation")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--batch", type=int, nargs="+", default=[512])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each batch size")
    parser.add_argument("--across", type=int, nargs=2, default=[14, 10], help="elements along x and y, or in the zone")
    parser.add_argument("--zone", type=float, nargs=2, help="mm; half width of the rectangle of even elements")
    parser.add_argument("--outside", type=int, nargs=2, default=[2, 2], help="elements on either side of the zone")
    parser.add_argument("--through", type=int, default=3)
    parser.add_argument("--growth", type=float, default=1.3)
    parser.add_argument("--depth", type=float, default=2.0, help="mm")
    parser.add_argument("--drag", type=float, default=0.0, help="mm")
    parser.add_argument("--steps", type=int, default=1, help="recorded states")
    parser.add_argument("--forcing", type=float, default=STANDARD.forcing, help="of linear solves: relative residual")
    parser.add_argument("--loose", type=float, default=STANDARD.loose, help="Newton's tolerance on the way")
    parser.add_argument("--step", type=float, help="mm; longest load step, default as in scenes")
    parser.add_argument("--inner", type=int, default=INNER, help="Krylov iterations of a cycle")
    parser.add_argument("--table", action="store_true", help="print the time of every kernel, too")
    given = parser.parse_args(arguments)
    mesh = shared_mesh(given.across, given.through, given.growth, given.zone, given.outside)
    began = time.perf_counter()
    pad = prepare(ball_scene(np.random.default_rng(0), given.depth, given.drag, given.steps), mesh, given.device)
    prepared = round(time.perf_counter() - began, 2)
    for batch in given.batch:
        path = (given.depth, given.drag, given.steps)
        found = measure(pad, batch, given.seconds, *path, given.forcing, given.inner, given.loose, given.step)
        kernels = found["profile"].pop("kernels")
        print(json.dumps({**vars(given), **found, "prepare_s": prepared}), flush=True)
        if given.table:
            print("\n".join(f"{ms:9.4f} ms a cycle  {name}" for name, ms in kernels.items()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
