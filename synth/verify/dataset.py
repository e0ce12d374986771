"""Verification of samples and datasets: all checks together.

The flow and its visibility are derived again at every pixel, in each direction, of a clip for every frame, and where
there is one the flow from the frame before. Of optional channels (depth, normal, displacement, traction, contact, slip)
it is checked that they are there (`flow_file_problems`); their values are not
derived again.
"""

import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.dataset.exr import ALIASES, OPTIONAL, read_channels
from synth.dataset.reader import Dataset, read_dataset
from synth.dataset.sample import Layout
from synth.dataset.sample_reader import SampleData, read_clip, read_meta
from synth.errors import InputError
from synth.scene import Outputs, Scene, Sensor
from synth.surface import GelSurface
from synth.verify.camera import ForwardCamera
from synth.verify.motion import check_motion
from synth.verify.photometry import check_photometry
from synth.verify.report import Check, Report, SampleReport
from synth.verify.sheet import Sheet

_NAMED = {"scene.hash": "scene_hash", "seed": "seed", "index": "index"}
"""Keys in the header of flow.exr, and the same in meta.json."""
_WORTHWHILE = 4
"""Fewest samples for which another process is begun."""


def verify_dataset(path: Path | str, progress: Callable[[int, int], None] | None = None, *, workers: int = 1) -> Report:
    """Verifies a dataset directory; `progress` is called after each sample with how many are done and of how many.

    At most `workers` processes share the samples. A damaged sample is a failed check; InputError where it is no
    dataset.
    """
    dataset = read_dataset(path)
    one, reports = partial(_verify_files, dataset), []
    processes = min(workers, len(dataset) // _WORTHWHILE)
    with ExitStack() as stack:
        found: Iterator[SampleReport] = map(one, dataset.samples)
        if processes > 1:
            ignored = (signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends this process, and this one those
            pool = ProcessPoolExecutor(processes, get_context("spawn"), signal.signal, ignored)
            at_once = 1 + len(dataset) // (16 * processes)
            found = stack.enter_context(pool).map(one, dataset.samples, chunksize=at_once)
        for report in found:
            reports.append(report)
            if progress is not None:
                progress(len(reports), len(dataset))
    return Report(dataset.path, tuple(reports))


def verify_sample(index: int, scene: Scene, sample: SampleData, problems: Sequence[str] = ()) -> SampleReport:
    """Verifies one sample, made from a drawn scene, against its own geometry.

    `problems` are what is wrong with its files (from `Dataset.check_hashes` and `flow_file_problems`).
    """
    checks = [_files(problems)]
    for name, sensor in scene.sensor.views.items():
        if name and name not in sample.further:
            checks.append(Check(f"{name}: images", 1.0, 0, "missing", "the scene has this camera, the sample has not"))
            continue
        seen = sample.seen_by(name)
        near, far = (_sheet(sensor, sample.surface, u) for u in (seen.displacement1, seen.displacement2))
        checks += _named(name, _pair_checks(sensor, scene.outputs.backward, seen, near, far))
    return SampleReport(index, tuple(checks))


def verify_clip(index: int, scene: Scene, folder: Path, problems: Sequence[str] = ()) -> SampleReport:
    """Verifies each frame of a clip against its own geometry; a check's figure is that of its worst frame."""
    worst: dict[str, Check] = {}
    for name, sensor in scene.sensor.views.items():
        clip = read_clip(folder, name)
        first = before = _sheet(sensor, clip.surface, clip.displacements[0])
        for frame in range(1, len(clip)):
            pair, now = clip.pair(0, frame), _sheet(sensor, clip.surface, clip.displacements[frame])
            checks = _pair_checks(sensor, scene.outputs.backward, pair, first, now)
            if scene.outputs.previous:
                u, v, visible = (pair.flow.extras[f"previous.{part}"] for part in ("U", "V", "visible"))
                checks += check_motion("previous", before, now, np.stack([u, v], axis=-1), visible)
            for check in _named(name, checks):
                told = replace(check, detail=f"frame {frame}: {check.detail}")
                worst[check.name] = max(worst.get(check.name, told), told, key=lambda one: one.badness)
            before = now
    return SampleReport(index, (_files(problems), *worst.values()))


def _named(camera: str, checks: Sequence[Check]) -> list[Check]:
    return [replace(check, name=f"{camera}: {check.name}" if camera else check.name) for check in checks]


def _sheet(sensor: Sensor, surface: GelSurface, displacement: FloatArray) -> Sheet:
    camera, moved = sensor.camera, surface.positions(displacement)
    return Sheet(ForwardCamera.of(sensor), surface.triangles, moved, camera.width, camera.height)


def _pair_checks(sensor: Sensor, backward: bool, sample: SampleData, near: Sheet, far: Sheet) -> list[Check]:
    camera, flow = sensor.camera, sample.flow
    checks = check_motion("forward", near, far, flow.forward, flow.forward_visible)
    if flow.backward is not None and flow.backward_visible is not None:
        checks += check_motion("backward", far, near, flow.backward, flow.backward_visible)
    elif backward:
        checks.append(Check("backward flow", 1.0, 0, "missing", "the scene asks for it and flow.exr lacks it"))
    size, image1, image2 = (camera.height, camera.width), sample.image1, sample.image2
    if image1 is not None and image2 is not None and flow.forward.shape[:2] == size and image1.shape[:2] == size:
        checks.append(check_photometry(sensor, image1, image2, flow.forward, flow.forward_visible))
    return checks


def _verify_files(dataset: Dataset, index: int) -> SampleReport:
    problems: list[str] = []
    try:
        problems += dataset.check_hashes(index)
        scene, folder = dataset.scene_of(index), dataset.folder(index)
        problems += flow_file_problems(folder, scene, read_meta(folder))
        if dataset.layout.is_of_clips:
            return verify_clip(index, scene, folder, problems)
        return verify_sample(index, scene, dataset.read(index), problems)
    except (InputError, OSError, MemoryError, RecursionError) as error:
        return SampleReport(index, (_files([*problems, str(error) or "out of memory"]),))


def _files(problems: Sequence[str]) -> Check:
    return Check("files", float(len(problems)), 0, "problems", "; ".join(problems) or "as manifest and scene say")


def flow_file_problems(folder: Path, scene: Scene, meta: Mapping[str, Any]) -> list[str]:
    """What is wrong with channels and headers of a sample's flow files; InputError if one is missing or damaged."""
    problems = []
    for name in Layout.of(scene.model_dump()).files(len(meta.get("frames", (0, 1)))):
        if not name.endswith(".exr"):
            continue
        planes, header = read_channels(folder / name)
        found = [*_channel_problems(planes, scene.outputs), *_header_problems(header, meta)]
        problems += [f"{name}: {problem}" for problem in found]
    return problems


def _channel_problems(planes: Mapping[str, np.ndarray], outputs: Outputs) -> list[str]:
    asked = [name for key, (names, _) in OPTIONAL.items() if getattr(outputs, key) for name in names]
    problems = [f"lacks the channel {name}" for name in (*asked, *ALIASES) if name not in planes]
    problems += [f"{name} is {plane.dtype}, not float32" for name, plane in planes.items() if plane.dtype != np.float32]
    for alias, name in ALIASES.items():
        if {alias, name} <= planes.keys() and not np.array_equal(planes[alias], planes[name], equal_nan=True):
            problems.append(f"{alias} is not {name}")
    return problems


def _header_problems(header: Mapping[str, str | int], meta: Mapping[str, Any]) -> list[str]:
    """Compared as text: OpenEXR's integers are too short for seeds."""
    return [
        f"its header has {key} = {header.get(key)}, meta.json {meta.get(name)}"
        for key, name in _NAMED.items()
        if str(header.get(key)) != str(meta.get(name))
    ]
