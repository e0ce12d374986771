"""Scheduling: which trajectories are still to do, who does them, and what happened.

In-process by default; with workers, one process each. The driver alone writes manifest and failures; samples' folders are
written where they are made. The same command goes on where it stopped.
"""

import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path

from synth import __version__
from synth.dataset.job import Job
from synth.dataset.writer import DatasetWriter
from synth.errors import InputError
from synth.mesh import pad_mesh
from synth.mesh.cache import user_cache
from synth.produce import Outcome, Producer, Workplace
from synth.render.pattern import is_grey
from synth.render.variant import Device, Variant, choose_variant
from synth.sampling import draw
from synth.template import Template

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
    """What renders a job: one channel where every draw of it is grey."""
    return choose_variant(device, grey=all(is_grey(scene.sensor) for scene in template.corners))


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

    Raises:
        InputError: wrong arguments, a directory of another job, storage that refuses.
    """
    if workers < 1:
        raise InputError(f"--workers = {workers}: at least 1")
    started = time.perf_counter()
    variant = variant or job_variant(template, "auto")
    job = make_job(template, n, seed, variant)
    with DatasetWriter(directory, job) as writer:
        place = Workplace(template, job, directory, variant, (directory / "meshes", user_cache()))
        found = len([i for i in writer.finished if i < n])
        made, given_up, failed, stages = 0, [], 0, {}
        for outcome in _outcomes(place, _tasks(place, n, writer.finished), workers):
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


Task = tuple[int, tuple[int, ...]]
"""A trajectory and its samples that are wanted."""


def _tasks(place: Workplace, n: int, finished: set[int]) -> Iterator[Task]:
    """Trajectories with samples to make. Each one's mesh is made here first: the mesher is random, so one process does it."""
    sampling = place.template.corners[0].sampling
    count = sampling.pairs_per_trajectory
    meshed = None
    for trajectory in range((n + count - 1) // count):
        wanted = tuple(i for i in range(trajectory * count, min(n, (trajectory + 1) * count)) if i not in finished)
        if not wanted:
            continue
        sensor = trajectory // sampling.trajectories_per_sensor
        if sensor != meshed:
            scene = draw(place.template, place.job.seed, trajectory)
            pad_mesh(scene.sensor.gel, scene.numerics, place.mesh_folders)
            meshed = sensor
        yield trajectory, wanted


def _outcomes(place: Workplace, tasks: Iterator[Task], workers: int) -> Iterator[Outcome]:
    if workers == 1:
        producer = Producer(place)
        for trajectory, wanted in tasks:
            yield producer.produce(trajectory, wanted)
        return
    place = replace(place, threads=max(1, (os.cpu_count() or 1) // workers))
    with ProcessPoolExecutor(workers, get_context("spawn"), _begin, (place,)) as pool:
        pending: set[Future[Outcome]] = set()
        try:
            for task in tasks:
                pending.add(pool.submit(_work, *task))
                while len(pending) >= 2 * workers:
                    done, pending = wait(pending, return_when=FIRST_COMPLETED)
                    yield from (future.result() for future in done)
            while pending:
                done, pending = wait(pending, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in done)
        except BrokenProcessPool as error:
            raise InputError(
                "a worker process died (out of memory, or killed); finished samples are kept: run the same command again"
            ) from error
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


_producer: Producer | None = None
"""A worker process's producer, set when the process starts."""


def _begin(place: Workplace) -> None:
    global _producer
    _producer = Producer(place)


def _work(trajectory: int, wanted: tuple[int, ...]) -> Outcome:
    if _producer is None:
        raise RuntimeError("the worker process was not set up by _begin")
    return _producer.produce(trajectory, wanted)


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
