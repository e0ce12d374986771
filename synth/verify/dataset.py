"""Verification of samples and datasets: all checks together.

The flow and its visibility are derived again at every pixel, in each direction. Of optional channels (depth, normal,
displacement, traction, contact) it is checked that they are there (`flow_file_problems`); their values are not
derived again.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.exr import ALIASES, OPTIONAL, read_channels
from synth.dataset.reader import Dataset, SampleData, read_dataset
from synth.errors import InputError
from synth.scene import Outputs, Scene, Sensor
from synth.verify.camera import ForwardCamera
from synth.verify.motion import check_motion
from synth.verify.photometry import check_photometry
from synth.verify.report import Check, Report, SampleReport
from synth.verify.sheet import Sheet

_NAMED = {"scene.hash": "scene_hash", "seed": "seed", "index": "index"}
"""Keys in the header of flow.exr, and the same in meta.json."""


def verify_dataset(path: Path | str, progress: Callable[[int, int], None] | None = None) -> Report:
    """Verifies a dataset directory; `progress` is called after each sample with how many are done and of how many.

    A damaged sample is a failed check; InputError where it is no dataset.
    """
    dataset = read_dataset(path)
    reports = []
    for index in dataset.samples:
        reports.append(_verify_files(dataset, index))
        if progress is not None:
            progress(len(reports), len(dataset))
    return Report(dataset.path, tuple(reports))


def verify_sample(index: int, scene: Scene, sample: SampleData, problems: Sequence[str] = ()) -> SampleReport:
    """Verifies one sample, made from a drawn scene, against its own geometry.

    `problems` are what is wrong with its files (from `Dataset.check_hashes` and `flow_file_problems`).
    """
    checks = [_files(problems)]
    for name, sensor in scene.sensor.views.items():
        prefix = f"{name}: " if name else ""
        if name and name not in sample.further:
            checks.append(Check(f"{prefix}images", 1.0, 0, "missing", "the scene has this camera, the sample has not"))
            continue
        own = _view_checks(sensor, scene.outputs.backward, sample.seen_by(name))
        checks += [replace(check, name=prefix + check.name) for check in own]
    return SampleReport(index, tuple(checks))


def _view_checks(sensor: Sensor, backward: bool, sample: SampleData) -> list[Check]:
    camera, flow = sensor.camera, sample.flow
    forward = ForwardCamera.of(sensor)
    states = [
        Sheet(forward, sample.surface.triangles, sample.surface.positions(u), camera.width, camera.height)
        for u in (sample.displacement1, sample.displacement2)
    ]
    checks = check_motion("forward", states[0], states[1], flow.forward, flow.forward_visible)
    if flow.backward is not None and flow.backward_visible is not None:
        checks += check_motion("backward", states[1], states[0], flow.backward, flow.backward_visible)
    elif backward:
        checks.append(Check("backward flow", 1.0, 0, "missing", "the scene asks for it and flow.exr lacks it"))
    size = (camera.height, camera.width)
    if flow.forward.shape[:2] == size and sample.image1.shape[:2] == size:
        checks.append(check_photometry(sensor, sample.image1, sample.image2, flow.forward, flow.forward_visible))
    return checks


def _verify_files(dataset: Dataset, index: int) -> SampleReport:
    problems: list[str] = []
    try:
        problems += dataset.check_hashes(index)
        scene, sample = dataset.scene_of(index), dataset.read(index)
        problems += flow_file_problems(dataset.folder(index), scene, sample.meta)
        return verify_sample(index, scene, sample, problems)
    except (InputError, OSError, MemoryError, RecursionError) as error:
        return SampleReport(index, (_files([*problems, str(error) or "out of memory"]),))


def _files(problems: Sequence[str]) -> Check:
    return Check("files", float(len(problems)), 0, "problems", "; ".join(problems) or "as manifest and scene say")


def flow_file_problems(folder: Path, scene: Scene, meta: Mapping[str, Any]) -> list[str]:
    """What is wrong with channels and headers of a sample's flow.exr files; InputError if one is missing or damaged."""
    problems = []
    for camera in scene.sensor.views:
        name = f"{camera}/flow.exr" if camera else "flow.exr"
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
