"""Does a sample hold the flow.exr files that its scene and its meta.json announce? Values are compared elsewhere."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.exr import ALIASES, read_channels
from synth.dataset.exr_channels import OPTIONAL
from synth.scene import Outputs, Scene

_NAMED = {"scene.hash": "scene_hash", "seed": "seed", "index": "index"}
"""Of the header, and of meta.json."""


def flow_file_problems(folder: Path, scene: Scene, meta: Mapping[str, Any]) -> list[str]:
    """What is wrong with the channels and headers of the flow.exr files in a sample's folder, one message each.

    Raises:
        InputError: a file is missing or damaged.
    """
    problems = []
    for camera in scene.sensor.views:
        name = f"{camera}/flow.exr" if camera else "flow.exr"
        planes, header = read_channels(folder / name)
        found = [*_channel_problems(planes, scene.outputs), *_header_problems(header, meta)]
        problems += [f"{name}: {problem}" for problem in found]
    return problems


def _channel_problems(planes: Mapping[str, np.ndarray], outputs: Outputs) -> list[str]:
    asked = [name for key in OPTIONAL if getattr(outputs, key) for name in OPTIONAL[key].names]
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
