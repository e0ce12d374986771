"""Draws of a scene and what the batched solver makes of them on a device, for `synth.bench.agreement`."""

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from synth.bench.agreement_noise import Noisy
from synth.errors import InputError
from synth.mesh import PadMesh
from synth.scene import Scene
from synth.scene.sampling import draw, pairs_of
from synth.scene.template import Template
from synth.simulate import Trajectory
from synth.simulate.batched.many import job_of, run_jobs
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.driver import Driver
from synth.simulate.shared import shared_mesh
from synth.simulate.solve import check_shared

LARGEST_BATCH = 256
_PAD: list[Pad] = []
"""Of this process."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A trajectory to be simulated; picklable.

    Attributes:
        number: of the trajectory.
        scene: fully drawn.
        mesh: the pad's.
        frames: numbers of the states that its samples show.
        folder: what a mesh indenter's file name is relative to.
    """

    number: int
    scene: Scene
    mesh: PadMesh
    frames: frozenset[int]
    folder: Path


def drawn_of(template: Template, count: int, seed: int) -> list[Drawn]:
    """The first draws of so many trajectories, as `generate` makes them; those that break the schema are left out.

    Raises:
        InputError: a scene or mesh that cannot be used; draws of different pads.
    """
    found: list[Drawn] = []
    first = template.corners[0]
    mesh = shared_mesh(first.sensor.gel, first.numerics)
    for number in range(count):
        try:
            scene = draw(template, seed, number)
        except InputError:
            continue
        frames = {frame for pair in pairs_of(template, seed, number, scene.motion.steps) for frame in pair.frames}
        found.append(Drawn(number, scene, mesh, frozenset(frames), template.source.parent))
    if found:
        check_shared([one.scene for one in found], mesh)
    return found


def together(drawn: Sequence[Drawn], device: str, driver: Driver, noise: float = 0.0) -> list[Trajectory | str]:
    """All draws in one batch.

    Args:
        drawn: of one pad.
        device: Warp device.
        driver: how Newton's method is led.
        noise: on a CPU, share by which the preconditioner's numbers are off.

    Returns:
        Each one's trajectory, or why its indenter cannot be built.
    """
    first = drawn[0]
    return _run(drawn, prepare(first.scene, first.mesh, device, Noisy(noise) if noise else None), driver)


def _run(drawn: Sequence[Drawn], pad: Pad, driver: Driver) -> list[Trajectory | str]:
    jobs, which = [], []
    found: dict[int, Trajectory | str] = {}
    for n, one in enumerate(drawn):
        try:
            jobs.append(job_of(one.scene, pad, one.folder))
        except InputError as error:
            found[n] = str(error)
            continue
        which.append(n)
    frames = [drawn[n].frames for n in which]
    for k, trajectory in run_jobs(jobs, pad, drawn[0].scene.numerics, frames, LARGEST_BATCH, driver):
        found[which[k]] = trajectory
    return [found[n] for n in range(len(drawn))]


def one_by_one(drawn: Sequence[Drawn], driver: Driver, processes: int) -> list[Trajectory | str]:
    """Each draw in a batch of its own on the CPU, in so many processes; what is returned as of `together`."""
    begin = (drawn[0].scene, drawn[0].mesh)
    if processes == 1:
        _begin(*begin)
        return [_alone(one, driver) for one in drawn]
    with ProcessPoolExecutor(processes, get_context("spawn"), _begin, begin) as pool:
        return list(pool.map(_alone, drawn, [driver] * len(drawn)))


def _begin(scene: Scene, mesh: PadMesh) -> None:
    """Prepare the pad of a process, once for all its draws."""
    _PAD[:] = [prepare(scene, mesh, "cpu")]


def _alone(one: Drawn, driver: Driver) -> Trajectory | str:
    return _run([one], _PAD[0], driver)[0]
