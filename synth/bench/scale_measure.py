"""Pairs per second of `generate` at one image size with some workers, and how near the stages are to their limits.

A run first makes one trajectory per worker, in which every process imports, compiles and reads, and which does not
count, and then 2 n pairs. Since draws come in a fixed order, the moment at which n of these are there is the time that
a run of n takes.

Limits, for the same frames and files:

    render  `Renderer.radiances` alone, warm, on one core, on a pressed surface of each trajectory, times its frames,
            and on the undeformed one of each sensor
    write   the bytes of a sample, already encoded, written and flushed to the same disk

Simulation and flow have none here: `bench fem` and `bench budget` say what a press costs.
"""

import json
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from synth.arrays import FloatArray
from synth.dataset.reader import Dataset, read_dataset
from synth.dataset.sample import MANIFEST_FILE
from synth.dataset.storage import flush
from synth.generate import Scheduling, generate, job_variant
from synth.mesh import rest_surface
from synth.processes.threads import render_on_one_core
from synth.render.pattern import albedo
from synth.render.renderer import Renderer
from synth.render.variant import Device, Variant
from synth.sampling import sensor_of, stream
from synth.template import Template, load_scene

REPEATS = 5
"""Of the measurement of the limit of writing; the median counts."""


@dataclass(frozen=True)
class Setting:
    """Image size in px, and worker processes; None: this process alone, which renders on all cores."""

    width: int
    height: int
    workers: int | None

    @property
    def by(self) -> str:
        """Who made the pairs."""
        if self.workers is None:
            return "no workers"
        return "1 worker" if self.workers == 1 else f"{self.workers} workers"


@dataclass(frozen=True)
class Cell:
    """What a run took.

    Attributes:
        setting: of the run.
        variant: that rendered.
        startup_s: until each worker had made a trajectory, which counts in nothing else.
        pairs: that were made after that.
        seconds: they took.
        first_pairs: the first half of them, or as near as trajectories of several pairs allow.
        first_seconds: these took.
        stages: stage -> seconds per pair, summed over workers.
        first_stages: the same over the first half alone.
        bytes_per_pair: on disk, with the line of the manifest.
        limits: stage -> seconds per pair that its innermost part takes alone on one core; in cells with one worker.
    """

    setting: Setting
    variant: str
    startup_s: float
    pairs: int
    seconds: float
    first_pairs: int
    first_seconds: float
    stages: Mapping[str, float]
    first_stages: Mapping[str, float]
    bytes_per_pair: float
    limits: Mapping[str, float]

    @property
    def pairs_per_second(self) -> float:
        """Beyond start-up."""
        return self.pairs / self.seconds

    @property
    def growth(self) -> float:
        """time(2 n) / time(n); 2 where cost is linear and the halves' draws cost the same."""
        return 2 * (self.seconds / self.pairs) / (self.first_seconds / self.first_pairs)

    @property
    def draws_growth(self) -> float:
        """The same of the work that the stages' own clocks counted: what `growth` is to be held to."""
        return 2 * sum(self.stages.values()) / sum(self.first_stages.values())


def at_size(scene: str, assignments: Sequence[str], width: int, height: int) -> Template:
    """A scene with changes ("key=value") and its main camera's image in another size, the field of view kept.

    Raises:
        InputError: the scene or a change of it is wrong.
    """
    template = load_scene(scene, assignments)
    camera = template.corners[0].sensor.camera
    if (width, height) == (camera.width, camera.height):
        return template
    x, y = width / camera.width, height / camera.height
    changed = {"fx": camera.fx * x, "cx": camera.cx * x, "fy": camera.fy * y, "cy": camera.cy * y}
    changes = [*assignments, f"sensor.camera.width={width}", f"sensor.camera.height={height}"]
    return load_scene(scene, [*changes, *(f"sensor.camera.{name}={value:.6f}" for name, value in changed.items())])


def measure(
    scene: str, assignments: Sequence[str], setting: Setting, n: int, device: Device, seed: int, folder: Path
) -> Cell:
    """Run 2 n pairs into a new folder, and with one worker the limits; the folder is removed.

    Raises:
        InputError: the scene cannot be built, the device is not there, the storage refuses.
    """
    template = at_size(scene, assignments, setting.width, setting.height)
    variant = job_variant(template, device)
    warm = (setting.workers or 1) * template.corners[0].sampling.pairs_per_trajectory
    times: dict[int, float] = {}
    shutil.rmtree(folder, ignore_errors=True)
    started = time.perf_counter()

    def note(done: int, _: int) -> None:
        times[done] = time.perf_counter() - started

    try:
        generate(template, warm + 2 * n, folder, seed, variant, Scheduling(setting.workers), note)
        entries = [json.loads(line) for line in (folder / MANIFEST_FILE).read_bytes().splitlines()]
        counted = [entry for entry in entries if entry["index"] >= warm]
        begin = min(done for done in times if done >= warm)
        half, end = min(done for done in times if done >= warm + n), max(times)
        bytes_per_pair = _size(folder) / len(entries)  # before the limits' own files
        limits = _limits(template, seed, variant, read_dataset(folder), counted) if setting.workers == 1 else {}
        return Cell(
            setting=setting,
            variant=variant.name,
            startup_s=times[begin],
            pairs=end - begin,
            seconds=times[end] - times[begin],
            first_pairs=half - begin,
            first_seconds=times[half] - times[begin],
            stages=_per_pair(counted),
            first_stages=_per_pair([entry for entry in counted if entry["index"] < half]),
            bytes_per_pair=bytes_per_pair,
            limits=limits,
        )
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _per_pair(entries: list[dict[str, Any]]) -> dict[str, float]:
    """Mean seconds by stage."""
    return {stage: sum(entry["seconds"][stage] for entry in entries) / len(entries) for stage in entries[0]["seconds"]}


def _size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file() and file.parent.name != "meshes")


def _limits(
    template: Template, seed: int, variant: Variant, dataset: Dataset, entries: list[dict[str, Any]]
) -> dict[str, float]:
    """Seconds per pair of the innermost parts of two stages."""
    trajectories: dict[int, list[dict[str, Any]]] = {}
    for entry in entries:
        trajectories.setdefault(entry["trajectory"], []).append(entry)
    rendered: set[int] = set()  # sensors whose undeformed gel is
    with _one_core(variant):
        render = sum(
            _seconds_to_render(template, seed, variant, dataset, pairs, rendered) for pairs in trajectories.values()
        )
    return {"render": render / len(entries), "write": _seconds_to_write(dataset.folder(dataset.samples[0]))}


@contextmanager
def _one_core(variant: Variant) -> Iterator[None]:
    """This process renders as a worker does."""
    variant.load()
    import drjit

    before = drjit.thread_count()
    render_on_one_core(variant)
    try:
        yield
    finally:
        drjit.set_thread_count(before)


def _seconds_to_render(
    template: Template,
    seed: int,
    variant: Variant,
    dataset: Dataset,
    pairs: list[dict[str, Any]],
    rendered: set[int],
) -> float:
    """The renderer alone on a trajectory's frames, everything compiled and built; one of them stands for all.

    Args:
        template: of the run.
        seed: of the run.
        variant: of the run.
        dataset: of the run.
        pairs: the trajectory's lines of the manifest.
        rendered: sensors whose undeformed gel has been rendered; this one's is added.
    """
    index = pairs[0]["index"]
    sample, scene = dataset.read(index), dataset.scene_of(index)
    sensor, gel = sensor_of(template, pairs[0]["trajectory"]), scene.sensor.gel
    rest, flat = rest_surface(gel), gel.dome_radius_mm is None
    texture = albedo(scene.sensor, stream(template, seed, "pattern", sensor), template.source.parent)
    renderer = Renderer(scene.sensor, scene.render, rest, texture, variant)
    seconds = 0.0
    if flat and sensor not in rendered:
        rendered.add(sensor)
        seconds = _seconds_of_frame(renderer, rest.material)
    renderer.take(sample.surface)
    frames = {frame for entry in pairs for frame in entry["frames"] if frame or not flat}
    return seconds + len(frames) * _seconds_of_frame(renderer, sample.surface.positions(sample.displacement2))


def _seconds_of_frame(renderer: Renderer, positions: FloatArray) -> float:
    renderer.radiances(positions, 0)
    return _timed(lambda: renderer.radiances(positions, 1))


def _seconds_to_write(folder: Path) -> float:
    """A sample's bytes to the same disk, flushed as `generate` does, nothing encoded."""
    files = [file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()]

    def write(target: Path) -> None:
        target.mkdir()
        for number, content in enumerate(files):
            (target / str(number)).write_bytes(content)
            flush(target / str(number))
        flush(target)
        os.rename(target, target.with_suffix(".done"))
        flush(target.parent)

    targets = [folder.parent / f".limit-{k}" for k in range(REPEATS)]
    return median(_timed(lambda target=target: write(target)) for target in targets)


def _timed(do: Any) -> float:
    started = time.perf_counter()
    do()
    return time.perf_counter() - started
