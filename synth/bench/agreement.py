"""Does a GPU give what the CPU gives? The same draws in one batch on a device and one by one on the CPU.

    python -m synth.bench.agreement --trajectories 16 --processes 8

prints one JSON line: how many draws end alike (status and reason), and for the complete ones how far apart the two are,
relative displacement and traction of the states that samples show, and the exact flow from rest to the last state in
pixels. With --device cpu --noise 3e-5 the device is the CPU with a preconditioner that is off by as much at random
(`synth.bench.agreement_noise`), without --noise it is the CPU, and all distances are 0. --loose 1e-3 leads the way as
loosely as the solver for one sample does, --forcing 0.03 solves linear systems as roughly as presses per second were
measured with.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.bench.agreement_draws import Drawn, drawn_of, one_by_one, together
from synth.errors import InputError
from synth.flow.exact import exact_flow
from synth.optics import Optics
from synth.scene.template import load_scene
from synth.simulate import Trajectory
from synth.simulate.batched.many import DRIVER
from synth.surface import GelSurface

WANTED = 1e-6
"""Relative distance of displacements that two devices may have."""
PARTS = 3
"""Triangles along an edge of a face whose flow is found; finer ones move both flows alike."""
LEAST_TRACTION = 1e-9
"""MPa: what tractions are compared with where there are none."""


@dataclass(frozen=True)
class Distance:
    """Between two complete trajectories of a draw: relative displacement and traction, flow in px."""

    displacement: float
    traction: float
    flow: float
    mean_flow: float


def distance(drawn: Drawn, one: Trajectory, other: Trajectory) -> Distance:
    """The largest of the states that samples show; of the flow largest and mean over the pixels, see the module."""
    shown = sorted(frame for frame in drawn.frames if frame)
    pairs = [(one.states[frame], other.states[frame]) for frame in shown]
    gap = np.linalg.norm(last_flow(drawn, one) - last_flow(drawn, other), axis=-1)
    seen = np.isfinite(gap)
    return Distance(
        displacement=max(_apart(a.displacement, b.displacement, LEAST_TRACTION) for a, b in pairs),
        traction=max(_apart(a.traction, b.traction, LEAST_TRACTION) for a, b in pairs),
        flow=float(gap[seen].max(initial=0.0)),
        mean_flow=float(gap[seen].mean()) if seen.any() else 0.0,
    )


def _apart(one: FloatArray, other: FloatArray, least: float) -> float:
    return float(np.abs(one - other).max() / max(np.abs(one).max(), least))


def last_flow(drawn: Drawn, trajectory: Trajectory) -> FloatArray:
    """(height, width, 2) exact flow from rest to the last state in the main camera; NaN where the gel is not seen."""
    space, sensor = trajectory.space, drawn.scene.sensor
    surface = GelSurface(space.surface, PARTS)
    pressed = surface.positions(trajectory.states[-1].displacement[space.surface_nodes])
    size = (sensor.camera.width, sensor.camera.height)
    field = exact_flow(surface, surface.material, pressed, Optics.of(sensor), *size, backward=False)
    return np.asarray(field.forward, dtype=np.float64)


def compare(
    drawn: Sequence[Drawn], device: Sequence[Trajectory | str], cpu: Sequence[Trajectory | str]
) -> dict[str, Any]:
    """What the command prints of two lots of results."""
    same, complete, others = 0, [], []
    for draw, one, other in zip(drawn, device, cpu, strict=True):
        ends = _end(one), _end(other)
        same += ends[0] == ends[1]
        if ends[0] != ends[1]:
            others.append({"trajectory": draw.number, "device": ends[0], "cpu": ends[1]})
        elif isinstance(one, Trajectory) and isinstance(other, Trajectory) and one.status == "complete":
            complete.append(distance(draw, one, other))
    displacement = [each.displacement for each in complete]
    return {
        "draws": len(drawn),
        "same_outcome": same,
        "other_outcomes": others,
        "complete": len(complete),
        "within_1e-6": sum(each <= WANTED for each in displacement),
        "displacement_median": float(np.median(displacement)) if complete else None,
        "displacement_largest": max(displacement, default=None),
        "traction_largest": max((each.traction for each in complete), default=None),
        "flow_px_largest": max((each.flow for each in complete), default=None),
        "flow_px_largest_mean": max((each.mean_flow for each in complete), default=None),
        "displacements": [float(f"{each:.2g}") for each in displacement],
    }


def _end(result: Trajectory | str) -> tuple[str, str]:
    return ("unbuilt", result) if isinstance(result, str) else (result.status, result.reason)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare and print a JSON line."""
    parser = argparse.ArgumentParser(description="the batched solver on a device against the CPU")
    parser.add_argument("--device", default="cuda", help="cuda or cpu")
    parser.add_argument("--noise", type=float, default=0.0, help="with --device cpu: of the preconditioner's numbers")
    parser.add_argument("--scene", default="gelsight_mini")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of generate; repeatable")
    parser.add_argument("--cells", type=int, nargs=3, default=[6, 4, 2], help="elements along x, y and z")
    parser.add_argument("--trajectories", type=int, default=16)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--processes", type=int, default=1, help="on the CPU")
    parser.add_argument("--loose", type=float, default=DRIVER.loose, help="Newton's tolerance on the way")
    parser.add_argument("--forcing", type=float, default=DRIVER.forcing, help="of linear solves: relative residual")
    given = parser.parse_args(arguments)
    try:
        if given.noise and given.device != "cpu":
            raise InputError(f"--noise with --device {given.device}: a GPU has its own; use cpu")
        if given.trajectories < 1 or given.processes < 1:
            raise InputError("--trajectories and --processes: ask for at least 1")
        if given.device == "cuda" and not wp.is_cuda_available():
            raise InputError("--device cuda: there is no NVIDIA GPU; try --device cpu --noise 3e-5")
        cells = f"numerics.cells={given.cells}"
        template = load_scene(given.scene, ['numerics.solver="batched"', cells, *given.set])
        drawn = drawn_of(template, given.trajectories, given.seed)
        if not drawn:
            raise InputError(f"none of {given.trajectories} draws of {given.scene} keeps the schema")
    except InputError as error:
        print(f"synth: {error}", file=sys.stderr)
        return 2
    driver = replace(DRIVER, loose=given.loose, forcing=given.forcing)
    began = time.perf_counter()
    on_device = together(drawn, given.device, driver, given.noise)
    middle = time.perf_counter()
    on_cpu = one_by_one(drawn, driver, given.processes)
    seconds = {"device_s": round(middle - began, 1), "cpu_s": round(time.perf_counter() - middle, 1)}
    tolerance = drawn[0].scene.numerics.tolerance
    print(json.dumps({**vars(given), "tolerance": tolerance, **compare(drawn, on_device, on_cpu), **seconds}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
