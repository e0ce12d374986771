"""From scenes and a mesh to trajectories, a batch at a time: the entry point."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path as FilePath

from synth.mesh import PadMesh
from synth.scene import Numerics, Scene
from synth.simulate.batched.jobs import Job, untouched
from synth.simulate.batched.pad import Pad, prepare
from synth.simulate.batched.run import Run
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.press import Press
from synth.simulate.solve import check_shared
from synth.simulate.trajectory import Trajectory

LARGEST_BATCH = 512
DRIVER = replace(STANDARD, relaxed_tolerance=0.0, forcing=1e-4, closer=1e-3)
"""The scene's tolerance all the way, because friction remembers the way, and Newton's own directions: with 1e-3
rounding could still decide, in a draw of a hundred, whether a correction was taken back, and so which balance was
found (docs/reports/batched_fem.md, Rounding). 11 to 13 % more cycles than with 1e-3. Corrections to a thousandth of the
tolerance, so that a Newton iteration more or less does not show; 4 % more iterations than with a tenth."""


def simulate_many(
    scenes: Sequence[Scene],
    mesh: PadMesh,
    folder: FilePath | None = None,
    device: str = "cuda",
    frames: frozenset[int] | Sequence[frozenset[int]] | None = None,
    batch: int = LARGEST_BATCH,
    driver: SolverOptions = DRIVER,
    pad: Pad | None = None,
) -> Iterator[tuple[int, Trajectory]]:
    """Press, shear and twist many scenes' indenters into pads of one mesh, each as if it were alone.

    Args:
        scenes: fully drawn; they share the gel's materials and the numerics.
        mesh: of their pad.
        folder: what a mesh indenter's file name is relative to.
        device: Warp device.
        frames: numbers of the states that are wanted, see `synth.simulate.simulate`: of all scenes, or of each.
        batch: most trajectories at a time.
        driver: how Newton's method is led along the paths.
        pad: of these scenes on that device, if it was prepared before.

    Yields:
        The number of a scene and its trajectory, in the order in which they end.

    Raises:
        InputError: scenes that do not share a pad; an indenter that cannot be built; CUDA without cuBLAS or cuSOLVER.
        ValueError: not as many sets of frames as scenes.
    """
    if not scenes:
        return
    first = scenes[0]
    check_shared(scenes, mesh)
    pad = pad or prepare(first, mesh, device)
    wanted = frames if isinstance(frames, Sequence) else None if frames is None else [frames] * len(scenes)
    yield from run_jobs(jobs_of(scenes, pad, folder), pad, first.numerics, wanted, batch, driver)


def run_jobs(
    jobs: Sequence[Job],
    pad: Pad,
    numerics: Numerics,
    frames: Sequence[frozenset[int]] | None = None,
    batch: int = LARGEST_BATCH,
    driver: SolverOptions = DRIVER,
) -> Iterator[tuple[int, Trajectory]]:
    """Run jobs of one pad; arguments, what is yielded and what is raised as of `simulate_many`.

    Args:
        jobs: from `job_of`.
        pad: theirs.
        numerics: of all of them.
        frames: numbers of the states that are wanted, of each job.
        batch: most trajectories at a time.
        driver: how Newton's method is led along the paths.
    """
    if frames is not None and len(frames) != len(jobs):
        raise ValueError(f"{len(frames)} sets of frames for {len(jobs)} jobs")
    for number, job in enumerate(jobs):
        if not job.touches:
            yield number, untouched(job, pad.space)
    touching = [number for number, job in enumerate(jobs) if job.touches]
    if touching:
        theirs = None if frames is None else [frames[n] for n in touching]
        run = Run([jobs[n] for n in touching], pad, numerics, driver, theirs, min(batch, len(touching)))
        for number, result in run:
            yield touching[number], result


def jobs_of(scenes: Sequence[Scene], pad: Pad, folder: FilePath | None = None) -> list[Job]:
    """What is to be run of each scene."""
    return [job_of(scene, pad, folder) for scene in scenes]


def job_of(scene: Scene, pad: Pad, folder: FilePath | None = None) -> Job:
    """What is to be run of a scene.

    Raises:
        InputError: the indenter cannot be built.
    """
    return Job.of(Press.of(scene, pad.mesh, folder))
