"""A scene that covers several units of one kind of sensor, each calibrated on its own.

Every number that differs between the units' sensors becomes a uniform distribution from the least to the greatest.
Lights belong together by channel and place; what one unit lacks has power 0 there.
"""

from collections.abc import Sequence
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from scipy.optimize import linear_sum_assignment

from synth.dataset.atomic_files import refuse_foreign, replace_file, storage_errors
from synth.errors import InputError
from synth.scene.template import checked_template, load_scene, with_files

SCENE = "scene.toml"
MARK = "Units of one kind, by `synth calibrate --units"
"""How the scene that is written begins."""


def run_units(units: Sequence[Path], out: Path) -> int:
    """Write OUT/scene.toml for two or more units: scene files of calibrate, or folders with one; returns 0.

    InputError for fewer, and for units that differ in more than numbers.
    """
    if len(units) < 2:
        raise InputError("--units: give two or more scenes that calibrate wrote, or their folders")
    paths = [unit / SCENE if unit.is_dir() else unit for unit in units]
    refuse_foreign(out / SCENE, MARK.encode())
    contents = [load_scene(path).content for path in paths]
    for content in contents:
        content["sensor"]["camera"].pop("rest_map", None)  # one unit's dust
    content = with_files(contents[0], lambda name: relpath(paths[0].parent / name, out))
    content["name"] = f"{content['name']}_units"
    sensors = [each["sensor"] for each in contents]
    for sensor, lights in zip(sensors, _together([each["lights"] for each in sensors]), strict=True):
        sensor["lights"] = lights
    content["sensor"] = covering(sensors, "sensor")
    checked_template(content, out / SCENE)
    with storage_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    comment = f"# {MARK} {' '.join(map(str, units))}`.\n"
    replace_file(out / SCENE, (comment + tomli_w.dumps(content)).encode())
    print(f"written: {out / SCENE}, a scene that covers {len(units)} units with {len(sensors[0]['lights'])} lights")
    return 0


def covering(values: Sequence[Any], where: str) -> Any:
    """One value for those of all units: what they share, or the distribution that covers their numbers."""
    first = values[0]
    if all(value == first for value in values):
        return first
    if all(isinstance(value, dict) and value.keys() == first.keys() for value in values):
        return {key: covering([value[key] for value in values], f"{where}.{key}") for key in first}
    if all(isinstance(value, list) and len(value) == len(first) for value in values):
        return [covering(each, f"{where}[{k}]") for k, each in enumerate(zip(*values, strict=True))]
    if all(isinstance(value, float) for value in values):
        return {"uniform": [min(values), max(values)]}
    raise InputError(
        f"--units: {where} is {' and '.join(map(repr, dict.fromkeys(map(str, values))))}; give units of one kind, "
        "calibrated from one scene and frames of one size"
    )


def _together(units: Sequence[list[dict[str, Any]]]) -> list[list[dict[str, Any]]]:
    """Each unit's lights in one order: beside each other are those of one channel that are nearest.

    In each channel the unit with the most lights leads.
    """
    ordered: list[list[dict[str, Any]]] = [[] for _ in units]
    for channel in range(3):
        own = [[light for light in lights if int(np.argmax(light["color"])) == channel] for lights in units]
        leading = max(own, key=len)
        for lights, mine in zip(ordered, own, strict=True):
            places = [np.array([light["position_mm"] for light in each]).reshape(-1, 1, 3) for each in (leading, mine)]
            distance = np.linalg.norm(places[0] - places[1].transpose(1, 0, 2), axis=2)
            partner = dict(zip(*linear_sum_assignment(distance), strict=True))
            lights += [mine[partner[k]] if k in partner else {**light, "power": 0.0} for k, light in enumerate(leading)]
    return ordered
