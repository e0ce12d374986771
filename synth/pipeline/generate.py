"""Scheduling: which trajectories are still to do, who does them, and what happened.

Few trajectories in this process, which renders on all cores; more of them in worker processes of one core each
(`worker_pool`); with Ray, on a cluster (`ray_pool`); or one shard of the job, beside others, such as those of several
GPUs (`devices`). With the batched solver this process simulates, and the workers do the rest (`overlapped`).

The driver alone writes manifest and failures; samples' folders are written where they are made. The same command goes
on where it stopped.
"""

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from operator import index
from pathlib import Path
from typing import Any

import numpy as np

from synth import __version__
from synth.dataset.job import Job
from synth.dataset.shard import Shard
from synth.dataset.store import Output, is_shared, output_of
from synth.dataset.summary import reason_group, shares
from synth.dataset.writer import DatasetWriter
from synth.errors import InputError
from synth.mesh import mesh_key, pad_mesh
from synth.mesh.cache import user_cache
from synth.pipeline.batched_simulation import BATCH
from synth.pipeline.devices import cuda_devices, on_devices
from synth.pipeline.overlapped import outcomes_of_batches
from synth.pipeline.producer import Producer
from synth.pipeline.ray_pool import outcomes_of_ray
from synth.pipeline.records import JobContext, Outcome, Task
from synth.pipeline.shared_gpus import share_gpus
from synth.pipeline.worker_pool import cores, outcomes_of_processes
from synth.planning import Plan, plan, predict
from synth.render.variant import Variant
from synth.sampling import draw_sensor, sensor_of
from synth.scene import Gel, Sensor
from synth.scene.template import Template

SOLVER_BYTES, WORKER_BYTES = 6 * 2**30, 2 * 2**30
"""GPU memory of the batched solver, and of a worker that renders."""
WORTH_A_WORKER = 4
"""Trajectories a core from which on worker processes, which take seconds to start, make them sooner."""
PACKAGES = ("mitsuba", "drjit", "warp-lang", "pytetwild", "pypardiso", "numpy", "scipy", "OpenEXR")


@dataclass(frozen=True)
class Scheduling:
    """Who makes a job's samples; they are the same whoever does.

    Attributes:
        workers: processes that make samples, on one core each; None: with a GPU, as many as there are cores beside
            this process's and as the GPU's memory holds; else one a core, as far as half of the memory holds them, or
            this process alone where there are few trajectories. With the batched solver 1 is for none. With Ray:
            tasks at once, None for all cores of the cluster.
        ray: address of a Ray cluster, or "local".
        shard: make this part of the job only.
        batch: most trajectories that the batched solver has under way at a time; None for what suits the device.
        devices: GPUs of this machine that share the job, each with `workers` of its own; None for all, where each has
            a batch to do.
    """

    workers: int | None = None
    ray: str | None = None
    shard: Shard | None = None
    batch: int | None = None
    devices: int | None = None


@dataclass
class Summary:
    """What `generate` did.

    Attributes:
        directory: of the dataset, or its URL.
        shard: "i/N", or None for the whole job.
        asked_for: samples that it was to see to.
        found: samples that were there already.
        made: samples written by this call.
        given_up: indices whose every instance failed.
        failures: stage and reason, numbers left out -> how many instances failed so and were replaced.
        seconds: wall time.
        stages: stage -> its seconds summed over samples.
    """

    directory: Output
    shard: str | None
    asked_for: int
    found: int
    made: int = 0
    given_up: list[int] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)
    seconds: float = 0.0
    stages: Counter[str] = field(default_factory=Counter)

    def add(self, outcome: Outcome) -> None:
        self.made += len(outcome.entries)
        self.given_up = sorted([*self.given_up, *outcome.given_up])
        self.failures.update(reason_group(failure.stage, failure.reason) for failure in outcome.failures)
        for entry in outcome.entries:
            self.stages.update(entry.seconds)

    @classmethod
    def of_all(cls, parts: list["Summary"]) -> "Summary":
        """The summary of a job from those of all its shards, without the time."""
        whole = cls(parts[0].directory, None, sum(part.asked_for for part in parts), sum(part.found for part in parts))
        for part in parts:
            whole.made += part.made
            whole.given_up = sorted([*whole.given_up, *part.given_up])
            whole.failures += part.failures
            whole.stages += part.stages
        return whole

    @property
    def failed_draws(self) -> int:
        return self.failures.total()

    @property
    def samples_per_second(self) -> float:
        return self.made / self.seconds if self.seconds > 0 else 0.0

    def record(self) -> dict[str, Any]:
        """Content of summary.json and of `--json`; without the place, so that a dataset can be moved."""
        return {
            "shard": self.shard,
            "asked_for": self.asked_for,
            "found": self.found,
            "made": self.made,
            "given_up": self.given_up,
            "failed_draws": self.failed_draws,
            "failures": dict(self.failures.most_common()),
            "seconds": round(self.seconds, 3),
            "samples_per_second": round(self.samples_per_second, 4),
            "stages": {stage: round(seconds, 3) for stage, seconds in self.stages.items()},
            "shares": shares(self.stages),
        }


Progress = Callable[[int, int], None]
"""Called with samples done and samples asked for."""


def make_job(plan: Plan, n: int, seed: int) -> Job:
    """The record of what is asked for; InputError for n < 1 or a negative seed, TypeError for fractions."""
    n, seed = index(n), index(seed)
    if n < 1:
        raise InputError(f"--n = {n}: ask for at least 1 sample")
    if seed < 0:
        raise InputError(f"--seed = {seed}: must not be negative")
    return Job(
        scene=plan.template.content,
        scene_name=plan.template.name,
        scene_hash=plan.template.hash,
        seed=seed,
        n=n,
        software={"gelflow-synth": __version__, **_versions()},
        device={"variant": plan.variant.name, "solver": "batched" if plan.is_batched else "single"},
    )


def generate(
    scene: Template | str | Path,
    n: int,
    out: Output,
    seed: int = 0,
    variant: Variant | None = None,
    scheduling: Scheduling | None = None,
    progress: Progress | None = None,
) -> Summary:
    """Write samples 0 .. n - 1 of a scene, or one shard of them; those that are there already are kept.

    Args:
        scene: of `load_scene`, or the name or path of one.
        n: number of samples in the dataset, at least 1.
        out: the dataset's directory or fsspec URL.
        seed: of everything random, not negative.
        variant: the renderer; by default the fastest here that the scene needs.
        scheduling: processes, cluster or shard that make the samples; by default this process makes all of them.
        progress: called after each trajectory with the number of samples done and of samples asked for.

    Returns:
        What was made, found and given up, and the seconds of each stage.

    Raises:
        InputError: wrong arguments, a scene that cannot be built, a place of another job, storage that refuses.
    """
    started = time.perf_counter()
    scheduling, out = scheduling or Scheduling(), output_of(out)
    _check(scheduling, out)
    planned = plan(scene, variant)
    job = make_job(planned, n, seed)
    count = planned.template.sampling.samples_per_trajectory
    if planned.variant.is_on_gpu and n // count >= BATCH["cuda"]:  # fewer would not win back the start of the service
        share_gpus()
    if (devices := _devices(planned, n // count, out, scheduling)) > 1:
        make = partial(_shard_on_device, planned.template, n, out, seed, planned.variant, scheduling, devices)
        summary = Summary.of_all(on_devices(make, devices, progress or (lambda done, asked_for: None)))
        with DatasetWriter(out, job, None, count) as writer:
            summary.seconds = time.perf_counter() - started
            writer.run = summary.record()
        return summary
    with DatasetWriter(out, job, scheduling.shard, count) as writer:
        context = JobContext(planned, job, out, user_cache())
        finished = writer.finished
        shard = scheduling.shard or Shard(0, 1)
        asked = sum(shard.makes(i // count) for i in range(n))
        found = sum(i < n and shard.makes(i // count) for i in finished)
        summary = Summary(out, str(shard) if scheduling.shard else None, asked, found)
        tasks, warned = _tasks(context, writer, n, finished, shard), False
        left = -(-(asked - found) // count)
        with closing(_outcomes(context, tasks, scheduling, left)) as outcomes:
            for outcome in outcomes:
                for failure in outcome.failures:
                    writer.fail(failure)
                for entry in outcome.entries:
                    writer.record(entry)
                for warning in () if warned else outcome.warnings:
                    print(f"synth: warning: {job.scene_name}: {warning}", file=sys.stderr, flush=True)
                warned = warned or bool(outcome.warnings)
                summary.add(outcome)
                if progress is not None:
                    progress(summary.found + summary.made + len(summary.given_up), summary.asked_for)
        summary.seconds = time.perf_counter() - started
        writer.run = summary.record()
    return summary


def _shard_on_device(
    template: Template,
    n: int,
    out: Output,
    seed: int,
    variant: Variant,
    scheduling: Scheduling,
    devices: int,
    number: int,
    progress: Progress,
) -> Summary:
    """What the process of GPU `number` does."""
    own = replace(scheduling, shard=Shard(number, devices), devices=1)
    return generate(template, n, out, seed, variant, own, progress)


def _devices(planned: Plan, trajectories: int, out: Output, scheduling: Scheduling) -> int:
    """How many GPUs share the job; InputError for more than there are, or than it can use."""
    asked = scheduling.devices
    alone = scheduling.shard is not None or scheduling.ray is not None or not isinstance(out, Path)
    if alone or not planned.variant.is_on_gpu or asked == 1:
        if asked is not None and asked > 1:
            raise InputError(f"--devices = {asked}: needs GPUs, a directory for --out, and neither --ray nor --shard")
        return 1
    there = cuda_devices()
    if asked is not None and asked > there:
        raise InputError(f"--devices = {asked}: there are {there}")
    return asked or max(1, min(there, trajectories // BATCH["cuda"]))


def _check(scheduling: Scheduling, out: Output) -> None:
    workers = scheduling.workers
    if workers is not None and workers < 1:
        raise InputError(f"--workers = {workers}: at least 1")
    if scheduling.batch is not None and scheduling.batch < 1:
        raise InputError(f"batch = {scheduling.batch}: at least 1 trajectory at a time")
    if not is_shared(out) and (scheduling.ray is not None or workers is not None):
        raise InputError(f"--out {out}: is seen by one process only; leave out --workers and --ray, or give another")


def _tasks(context: JobContext, writer: DatasetWriter, n: int, finished: set[int], shard: Shard) -> Iterator[Task]:
    """Trajectories with samples to make. Their meshes are made here: the mesher is random, so one process does it.

    InputError where a mesh cannot be made or kept.
    """
    template = context.plan.template
    count = template.sampling.samples_per_trajectory
    meshed = None
    for trajectory in range(shard.number, (n + count - 1) // count, shard.count):
        wanted = tuple(i for i in range(trajectory * count, min(n, (trajectory + 1) * count)) if i not in finished)
        if not wanted:
            continue
        sensor = sensor_of(template, trajectory)
        if sensor != meshed and context.mesh_folders:
            instance = draw_sensor(template, context.job.seed, sensor)
            if instance.content is not None:
                _store_mesh(context, writer, Sensor.model_validate(instance.content["sensor"]).gel)
            meshed = sensor
        yield trajectory, wanted


def _store_mesh(context: JobContext, writer: DatasetWriter, gel: Gel) -> None:
    """Have the dataset hold a pad's fTetWild mesh: without, every trajectory would make another one."""
    numerics = context.plan.template.numerics
    with writer.making_meshes() as folder:
        pad_mesh(gel, numerics, (folder, context.cache), context.plan.template.folder)
        stored = folder / f"{mesh_key(gel, numerics)}.npz"
        if not stored.is_file():
            raise InputError(f"{stored}: the mesh cannot be written; put this right and give the same command again")


def _outcomes(
    context: JobContext, tasks: Iterator[Task], scheduling: Scheduling, left: int
) -> Generator[Outcome, None, None]:
    if scheduling.ray is not None:
        yield from outcomes_of_ray(context, tasks, scheduling.ray, scheduling.workers)
        return
    workers = scheduling.workers or _workers_here(context, left)
    if context.plan.is_batched:
        yield from outcomes_of_batches(context, tasks, workers or 1, scheduling.batch)
    elif workers is not None:
        yield from outcomes_of_processes(context, tasks, workers)
    else:
        producer = Producer(context)
        for task in tasks:
            yield producer.produce(*task)


def _workers_here(context: JobContext, trajectories: int) -> int | None:
    """Worker processes for so many trajectories that share a GPU or the cores; None where this process does it."""
    if not is_shared(context.out):
        return None
    if not context.plan.variant.is_on_gpu:
        if context.plan.is_batched or cores() == 1 or trajectories < WORTH_A_WORKER * cores():
            return None
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        return min(cores(), memory // 2 // predict(context.plan).memory_bytes) or None
    from synth.warp_start import start_warp

    start_warp()
    import warp as wp

    room = wp.get_device("cuda").free_memory - SOLVER_BYTES
    return int(np.clip(room // WORKER_BYTES, 1, max(1, cores() - 1)))


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
