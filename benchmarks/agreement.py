"""Does a GPU give what the CPU gives? The same draws in one batch on a device and one by one on the CPU.

    python -m benchmarks agreement --trajectories 64 --cells 16 12 2 --processes 16
    python -m benchmarks agreement --device cpu --noise 3e-5            without a GPU

A row tells of a draw whether both end alike (status and reason), and if both are complete how far apart they are:
relative displacement and traction, the largest of the states that samples show, and the exact flow from rest to the
last state in px. With --device cpu --noise 3e-5 the device is the CPU with a preconditioner whose every number is off
by as much at random, as a GPU's is by its sums; Newton's method corrects that, but for draws that are near a second
equilibrium. --relaxed solves intermediate steps, --forcing linear systems more roughly than `generate` does.
"""

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import warp as wp

from benchmarks.rows import Row, arguments, machine, measure, show
from synth.arrays import FloatArray
from synth.cli_options import DEFAULT_SCENE
from synth.errors import InputError
from synth.flow.exact import exact_flow
from synth.flow.view import View
from synth.mesh import PadMesh
from synth.optics import Optics
from synth.press.press import Press
from synth.press.resolution import shared_mesh
from synth.sampling import draw, samples_of
from synth.scene import Scene
from synth.scene.template import Template, load_scene
from synth.simulate import Trajectory
from synth.simulate.batched.gpu import Host
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.batched.run import OPTIONS, simulate_presses
from synth.simulate.options import SolverOptions
from synth.simulate.solve import check_shared
from synth.surface import GelSurface

WANTED = 1e-6
"""Relative distance of displacements that two devices may have."""
PARTS = 3
"""Triangles along an edge of a face whose flow is found; finer ones move both flows alike."""
LEAST_TRACTION = 1e-9
"""MPa: what tractions are compared with where there are none."""
LARGEST_BATCH = 256
_PAD: list[Pad] = []
"""Of this process."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A trajectory to be simulated: number, scene and mesh, the states that samples show, and the scene's folder."""

    number: int
    scene: Scene
    mesh: PadMesh
    frames: frozenset[int]
    folder: Path


def drawn_of(template: Template, count: int, seed: int) -> list[Drawn]:
    """The first draws of so many trajectories, as `generate` makes them; those that break the schema are left out.

    Raises:
        InputError: none of them can be used; draws of different pads.
    """
    first = template.corners[0]
    mesh = shared_mesh(first.sensor.gel, first.numerics)
    found: list[Drawn] = []
    for number in range(count):
        try:
            scene = draw(template, seed, number)
        except InputError:
            continue
        frames = {frame for pair in samples_of(template, seed, number, scene.motion.steps) for frame in pair.frames}
        found.append(Drawn(number, scene, mesh, frozenset(frames), template.source.parent))
    if not found:
        raise InputError(f"none of {count} draws of {template.label} keeps the schema; ask for more --trajectories")
    check_shared([one.scene for one in found], mesh)
    return found


class Noisy(Host):
    """The CPU's dense product with each number times 1 plus `share` times a standard normal."""

    def __init__(self, share: float) -> None:
        self._share, self._rng = np.float32(share), np.random.default_rng(0)

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """See `synth.simulate.batched.gpu.Dense`."""
        super().product(a, x, c, wanted)
        found = c.numpy()
        for s in np.flatnonzero(wanted.numpy() == 1):
            found[s] *= 1 + self._share * self._rng.standard_normal(found.shape[1], dtype=np.float32)


def together(drawn: Sequence[Drawn], pad: Pad, options: SolverOptions) -> list[Trajectory | str]:
    """All draws in one batch: each one's trajectory, or why its indenter cannot be built."""
    presses, which = [], []
    found: dict[int, Trajectory | str] = {}
    for n, one in enumerate(drawn):
        try:
            presses.append(Press.of(one.scene, one.mesh, one.folder))
        except InputError as error:
            found[n] = str(error)
            continue
        which.append(n)
    asked = [(press, drawn[n].frames) for n, press in zip(which, presses, strict=True)]
    for k, trajectory in simulate_presses(asked, pad, LARGEST_BATCH, options):
        found[which[k]] = trajectory
    return [found[n] for n in range(len(drawn))]


def one_by_one(drawn: Sequence[Drawn], options: SolverOptions, processes: int) -> list[Trajectory | str]:
    """Each draw in a batch of its own on the CPU; what is returned as of `together`."""
    begin = (drawn[0].scene, drawn[0].mesh)
    if processes == 1:
        _begin(*begin)
        return [_alone(one, options) for one in drawn]
    with ProcessPoolExecutor(processes, get_context("spawn"), _begin, begin) as pool:
        return list(pool.map(_alone, drawn, [options] * len(drawn)))


def _begin(scene: Scene, mesh: PadMesh) -> None:
    """Prepare the pad of a process, once for all its draws."""
    _PAD[:] = [prepare(scene, mesh, "cpu")]


def _alone(one: Drawn, options: SolverOptions) -> Trajectory | str:
    return together([one], _PAD[0], options)[0]


def compare(one: Drawn, device: Trajectory | str, cpu: Trajectory | str) -> Row:
    """One row of the table."""
    ends = [("unbuilt", each) if isinstance(each, str) else (each.status, each.reason) for each in (device, cpu)]
    row: Row = {"trajectory": one.number, "same": ends[0] == ends[1], "status": ends[0][0], "cpu_status": ends[1][0]}
    if isinstance(device, str) or isinstance(cpu, str) or {ends[0][0], ends[1][0]} != {"complete"}:
        return {**row, "reason": ends[0][1], "cpu_reason": ends[1][1]}
    shown = [(device.states[frame], cpu.states[frame]) for frame in sorted(one.frames - {0})]
    gap = np.linalg.norm(last_flow(one, device) - last_flow(one, cpu), axis=-1)
    gap = gap[np.isfinite(gap)]
    return {
        **row,
        "displacement": max(_apart(a.displacement, b.displacement) for a, b in shown),
        "traction": max(_apart(a.traction, b.traction) for a, b in shown),
        "flow_px": float(gap.max(initial=0.0)),
        "mean_flow_px": float(gap.mean()) if len(gap) else 0.0,
        "iterations": sum(state.newton_iterations for state in device.states),
        "cpu_iterations": sum(state.newton_iterations for state in cpu.states),
    }


def _apart(one: FloatArray, other: FloatArray) -> float:
    return float(np.abs(one - other).max() / max(np.abs(one).max(), LEAST_TRACTION))


def last_flow(one: Drawn, trajectory: Trajectory) -> FloatArray:
    """(height, width, 2) exact flow from rest to the last state in the main camera; NaN where the gel is not seen."""
    space, sensor = trajectory.space, one.scene.sensor
    surface = GelSurface(space.surface, PARTS)
    pressed = surface.positions(trajectory.states[-1].displacement[space.surface_nodes])
    field = exact_flow(View(surface, Optics.of(sensor)), surface.material, pressed, backward=False)
    return np.asarray(field.forward, dtype=np.float64)


def run(case: Row, drawn: Sequence[Drawn], processes: int) -> list[Row]:
    """A row for each draw."""
    options = replace(OPTIONS, relaxed_tolerance=case["relaxed"], forcing=case["forcing"])
    noisy = Noisy(case["noise"]) if case["noise"] else None
    on_device = together(drawn, prepare(drawn[0].scene, drawn[0].mesh, case["device"], noisy), options)
    return list(map(compare, drawn, on_device, one_by_one(drawn, options, processes)))


def summary(rows: Sequence[Row]) -> Row:
    """Counts and distances of all draws."""
    complete = [row for row in rows if row.get("displacement") is not None]
    return {
        "draws": len(rows),
        "end alike": sum(row["same"] for row in rows),
        "complete": len(complete),
        "within 1e-6": sum(row["displacement"] <= WANTED for row in complete),
        "displacement, median": float(np.median([row["displacement"] for row in complete])) if complete else None,
        **{
            f"{name}, largest": max((row[name] for row in complete), default=None)
            for name in ("displacement", "traction", "flow_px", "mean_flow_px")
        },
        **{name: sum(row[name] for row in complete) for name in ("iterations", "cpu_iterations")},
    }


def main(argv: list[str]) -> int:
    """Run the command line; 1 if a draw ends otherwise on the device or its displacement is not within WANTED."""
    parser = arguments("agreement", __doc__)
    parser.add_argument("--device", default="cuda", help="cuda or cpu; default: cuda")
    parser.add_argument("--noise", type=float, default=0.0, help="with --device cpu: of the preconditioner's numbers")
    parser.add_argument("--scene", default=DEFAULT_SCENE)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of generate; repeatable")
    parser.add_argument("--cells", type=int, nargs=3, default=[6, 4, 2], help="elements along x, y and z")
    parser.add_argument("--trajectories", type=int, default=16)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--processes", type=int, default=1, help="on the CPU")
    parser.add_argument("--relaxed", type=float, default=OPTIONS.relaxed_tolerance, help="of intermediate steps")
    parser.add_argument("--forcing", type=float, default=OPTIONS.forcing, help="relative residual of linear solves")
    given = parser.parse_args(argv)
    if given.noise and given.device != "cpu":
        raise InputError(f"--noise with --device {given.device}: a GPU has its own; use cpu")
    if given.trajectories < 1 or given.processes < 1:
        raise InputError("--trajectories and --processes: ask for at least 1")
    if given.device == "cuda" and not wp.is_cuda_available():
        raise InputError("--device cuda: there is no NVIDIA GPU; try --device cpu --noise 3e-5")
    template = load_scene(given.scene, ['numerics.solver="batched"', f"numerics.cells={given.cells}", *given.set])
    drawn = drawn_of(template, given.trajectories, given.seed)
    print(machine())
    options = ("device", "noise", "scene", "trajectories", "seed", "relaxed", "forcing")
    case = {**{name: getattr(given, name) for name in options}, "hash": template.hash}
    rows = measure(given.out / "agreement.csv", [case], partial(run, drawn=drawn, processes=given.processes))
    found = summary(rows)
    others = [row for row in rows if not row["same"]]
    show(others, ["trajectory", "status", "reason", "cpu_status", "cpu_reason"], "Draws that do not end alike")
    show([found], list(found), f"{given.device} against the CPU, one draw at a time")
    return 0 if found["within 1e-6"] == found["complete"] and found["end alike"] == found["draws"] else 1
