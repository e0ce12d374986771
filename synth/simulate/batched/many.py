"""From scenes and a mesh to trajectories, a batch at a time: the entry point."""

from collections.abc import Iterator, Sequence
from pathlib import Path as FilePath

from synth.mesh import PadMesh
from synth.scene import Scene
from synth.simulate.batched.jobs import Job, untouched
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.batched.run import Run
from synth.simulate.driver import STANDARD, Driver
from synth.simulate.indenter import rigid_body
from synth.simulate.path import Path
from synth.simulate.solve import check_shared
from synth.simulate.trajectory import Trajectory

LARGEST_BATCH = 512


def simulate_many(
    scenes: Sequence[Scene],
    mesh: PadMesh,
    folder: FilePath | None = None,
    device: str = "cuda",
    frames: frozenset[int] | None = None,
    batch: int = LARGEST_BATCH,
    driver: Driver = STANDARD,
    pad: Pad | None = None,
) -> Iterator[tuple[int, Trajectory]]:
    """Press, shear and twist many scenes' indenters into pads of one mesh, each as if it were alone.

    Args:
        scenes: fully drawn; they share the gel's materials and the numerics.
        mesh: of their pad.
        folder: what a mesh indenter's file name is relative to.
        device: Warp device.
        frames: numbers of the states that are wanted, see `synth.simulate.simulate`.
        batch: most trajectories at a time.
        driver: how Newton's method is led along the paths.
        pad: of these scenes on that device, if it was prepared before.

    Yields:
        The number of a scene and its trajectory, in the order in which they end.

    Raises:
        InputError: scenes that do not share a pad; an indenter that cannot be built; CUDA without cuBLAS.
    """
    if not scenes:
        return
    first = scenes[0]
    check_shared(scenes, mesh)
    pad = pad or prepare(first, mesh, device)
    jobs = jobs_of(scenes, pad, folder)
    for number, job in enumerate(jobs):
        if not job.touches:
            yield number, untouched(job, pad.space)
    touching = [number for number, job in enumerate(jobs) if job.touches]
    if touching:
        run = Run([jobs[n] for n in touching], pad, first.numerics, driver, frames, min(batch, len(touching)))
        for number, result in run:
            yield touching[number], result


def jobs_of(scenes: Sequence[Scene], pad: Pad, folder: FilePath | None = None) -> list[Job]:
    """What is to be run of each scene."""
    resolved = pad.mesh.spacing_mm / (2 * pad.space.element.order)
    return [
        Job(
            Path(
                scene.motion,
                rigid_body(scene.contact.indenter, folder, resolved),
                scene.sensor.gel.dome_radius_mm,
            ),
            scene.contact.friction,
            scene.sensor.gel.youngs_modulus_kpa / 1000,
        )
        for scene in scenes
    ]
