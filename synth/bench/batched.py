"""Presses per second of the batched simulation, and what a cycle's time goes into.

    python -m synth.bench.batched --batch 512 --seconds 60

prints one JSON line per batch size; with --table also what each kernel takes of a cycle. A press is a ball of 2 to 6 mm
radius (--radii) at a random place of a 20 x 15 x 4 mm pad, pressed to half its thickness with friction, every step
converged as in `synth generate` (on the way less, with --loose), and one state recorded and corrected. Bodies that
begin and end are counted as they do in production: slots are refilled, and the rate is counted from when as many have
ended as there are slots. Results travel to the host within that time. With --errors N it prints instead how wrong the
first N presses are on that mesh with that --loose and --step, found on the CPU.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from typing import Any

import numpy as np
import warp as wp

from synth.bench.batched_clock import Clock, Events
from synth.bench.batched_errors import surface_errors
from synth.bench.batched_presses import RADII_MM, ball_scene, shared_mesh
from synth.simulate.batched.krylov import RUNNING, WAITING
from synth.simulate.batched.machine import INNER
from synth.simulate.batched.many import DRIVER, jobs_of
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.batched.run import Run

PROFILED_CYCLES = 20
DRAWS = 2048
"""Different presses; they are gone through again and again, so that drawing them takes no part of the time."""


def measure(
    pad: Pad,
    batch: int,
    seconds: float,
    depth_mm: float = 2.0,
    drag_mm: float = 0.0,
    steps: int = 1,
    forcing: float = DRIVER.forcing,
    inner: int = INNER,
    loose: float = DRIVER.loose,
    closer: float = DRIVER.closer,
    step_mm: float | None = None,
    seed: int = 0,
    radii_mm: Sequence[float] = RADII_MM,
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
        closer: tolerance of corrections over the scenes'.
        step_mm: longest load step; default the scenes'.
        seed: of the draws.
        radii_mm: of the balls, smallest and largest.
    """
    rng = np.random.default_rng(seed)
    draws = [ball_scene(rng, depth_mm, drag_mm, steps, radii_mm) for _ in range(max(DRAWS, batch))]
    began = time.perf_counter()
    order = cycle(range(len(draws)))
    driver = replace(DRIVER, forcing=forcing, loose=loose, closer=closer)
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
    parser.add_argument("--forcing", type=float, default=DRIVER.forcing, help="of linear solves: relative residual")
    parser.add_argument("--loose", type=float, default=DRIVER.loose, help="Newton's tolerance on the way")
    parser.add_argument("--closer", type=float, default=DRIVER.closer, help="tolerance of corrections over the scene's")
    parser.add_argument("--step", type=float, help="mm; longest load step, default as in scenes")
    parser.add_argument("--inner", type=int, default=INNER, help="Krylov iterations of a cycle")
    parser.add_argument("--radii", type=float, nargs=2, default=list(RADII_MM), help="mm; of the balls")
    parser.add_argument("--errors", type=int, metavar="N", help="instead: surface errors of the first N presses")
    parser.add_argument("--table", action="store_true", help="print the time of every kernel, too")
    given = parser.parse_args(arguments)
    mesh = shared_mesh(given.across, given.through, given.growth, given.zone, given.outside)
    if given.errors is not None:
        driver = replace(DRIVER, loose=given.loose)
        for found in surface_errors(mesh, given.errors, given.depth, given.radii, driver=driver, step_mm=given.step):
            print(json.dumps(found), flush=True)
        return 0
    began = time.perf_counter()
    pad = prepare(ball_scene(np.random.default_rng(0), given.depth, given.drag, given.steps), mesh, given.device)
    prepared = round(time.perf_counter() - began, 2)
    for batch in given.batch:
        path = (given.depth, given.drag, given.steps)
        way = (given.forcing, given.inner, given.loose, given.closer, given.step)
        found = measure(pad, batch, given.seconds, *path, *way, radii_mm=given.radii)
        kernels = found["profile"].pop("kernels")
        print(json.dumps({**vars(given), **found, "prepare_s": prepared}), flush=True)
        if given.table:
            print("\n".join(f"{ms:9.4f} ms a cycle  {name}" for name, ms in kernels.items()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
