"""Scheduling: which trajectories are still to do, who does them, and what happened.

In-process by default; with workers, one process each (`synth.processes`). The driver alone writes manifest and
failures; samples' folders are written where they are made. The same command goes on where it stopped.
"""

import re
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from synth import __version__
from synth.dataset.job import Job
from synth.dataset.writer import DatasetWriter
from synth.errors import InputError
from synth.mesh import mesh_key, pad_mesh
from synth.mesh.cache import user_cache
from synth.plan import check_buildable
from synth.processes import outcomes_of_processes
from synth.produce import Outcome, Producer, Task, Workplace
from synth.render.pattern import is_grey
from synth.render.variant import Device, Variant, choose_variant
from synth.sampling import draw_sensor, sensor_of
from synth.scene import Gel
from synth.template import Template

MESHES_FOLDER = "meshes"
PACKAGES = ("mitsuba", "drjit", "warp-lang", "pytetwild", "pypardiso", "numpy", "scipy", "OpenEXR")


@dataclass(frozen=True)
class Summary:
    """What `generate` did.

    Attributes:
        directory: of the dataset.
        made: samples written by this call.
        found: samples that were there already.
        given_up: indices whose every draw failed.
        failed_draws: draws that failed and were redrawn.
        seconds: wall time.
        stages: stage -> its seconds summed over samples.
    """

    directory: Path
    made: int
    found: int
    given_up: tuple[int, ...]
    failed_draws: int
    seconds: float
    stages: dict[str, float]


Progress = Callable[[int, int], None]
"""Called with samples done and samples asked for."""


def job_variant(template: Template, device: Device) -> Variant:
    """What renders a job: one channel where every draw of it is grey.

    Raises:
        InputError: the device is not there.
    """
    # Corners that are grey say nothing of the draws between them where a single channel is drawn.
    drawn = any(re.search(r"\.(color|reflectance)\[\d\]$|\.saturation$", at) for _, _, at in template.distributions())
    return choose_variant(device, grey=not drawn and all(is_grey(scene.sensor) for scene in template.corners))


def make_job(template: Template, n: int, seed: int, variant: Variant) -> Job:
    """The record of what is asked for.

    Raises:
        InputError: n < 1 or a negative seed.
    """
    if n < 1:
        raise InputError(f"--n = {n}: ask for at least 1 sample")
    if seed < 0:
        raise InputError(f"--seed = {seed}: must not be negative")
    return Job(
        scene=template.content,
        scene_name=template.name,
        scene_hash=template.hash,
        seed=seed,
        n=n,
        software={"gelflow-synth": __version__, **_versions()},
        device={"variant": variant.name},
    )


def generate(
    template: Template,
    n: int,
    directory: Path,
    seed: int = 0,
    variant: Variant | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Summary:
    """Write samples 0 .. n - 1 of a scene; those that are there already are kept.

    Args:
        template: the scene.
        n: samples in the dataset.
        directory: of the dataset.
        seed: of everything random.
        variant: that renders; default the fastest here.
        workers: processes; 1 stays in this one.
        progress: told after each trajectory.

    Raises:
        InputError: wrong arguments, a scene that cannot be built, a directory of another job, storage that refuses.
    """
    if workers < 1:
        raise InputError(f"--workers = {workers}: at least 1")
    started = time.perf_counter()
    variant = variant or job_variant(template, "auto")
    job = make_job(template, n, seed, variant)
    check_buildable(template, variant)
    with DatasetWriter(directory, job) as writer:
        place = Workplace(template, job, directory, variant, (directory / MESHES_FOLDER, user_cache()))
        finished = writer.finished
        found = sum(i < n for i in finished)
        made, failed = 0, 0
        given_up: list[int] = []
        stages: dict[str, float] = {}
        with closing(_outcomes(place, _tasks(place, n, finished), workers)) as outcomes:
            for outcome in outcomes:
                for failure in outcome.failures:
                    writer.fail(failure.index, failure.draw, failure.stage, failure.reason, failure.last_good_state)
                for entry in outcome.entries:
                    writer.record(entry)
                    for stage, seconds in entry.seconds.items():
                        stages[stage] = stages.get(stage, 0.0) + seconds
                made += len(outcome.entries)
                given_up += outcome.given_up
                failed += len(outcome.failures)
                if progress is not None:
                    progress(found + made + len(given_up), n)
    return Summary(directory, made, found, tuple(sorted(given_up)), failed, time.perf_counter() - started, stages)


def _tasks(place: Workplace, n: int, finished: set[int]) -> Iterator[Task]:
    """Trajectories with samples to make. Their meshes are made here: the mesher is random, so one process does it.

    Raises:
        InputError: a mesh cannot be made or kept.
    """
    template = place.template
    count = template.corners[0].sampling.pairs_per_trajectory
    meshed = None
    for trajectory in range((n + count - 1) // count):
        wanted = tuple(i for i in range(trajectory * count, min(n, (trajectory + 1) * count)) if i not in finished)
        if not wanted:
            continue
        sensor = sensor_of(template, trajectory)
        if sensor != meshed:
            drawn = draw_sensor(template, place.job.seed, sensor)
            if drawn.content is not None and template.corners[0].numerics.edge_length_mm is not None:
                _keep_mesh(place, Gel.model_validate(drawn.content["sensor"]["gel"]))
            meshed = sensor
        yield trajectory, wanted


def _keep_mesh(place: Workplace, gel: Gel) -> None:
    """Have the dataset hold a pad's fTetWild mesh: without, every trajectory would make another one."""
    numerics = place.template.corners[0].numerics
    pad_mesh(gel, numerics, place.mesh_folders)
    kept = place.mesh_folders[0] / f"{mesh_key(gel, numerics)}.npz"
    if not kept.is_file():
        raise InputError(f"{kept}: the mesh cannot be written; put this right and give the same command again to go on")


def _outcomes(place: Workplace, tasks: Iterator[Task], workers: int) -> Generator[Outcome, None, None]:
    if workers > 1:
        yield from outcomes_of_processes(place, tasks, workers)
        return
    producer = Producer(place)
    for trajectory, wanted in tasks:
        yield producer.produce(trajectory, wanted)


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
