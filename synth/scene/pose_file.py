"""Poses of the indenter from a file, such as a robot's or a simulator's log of a grasp.

The file is CSV with the header HEADER and a line for each frame: time in s; the place of the object's frame in the
sensor's, mm; and its turn, a unit quaternion, of which the real part comes last. What a quaternion turns is in the
sensor's left-handed axes, as everywhere in a scene: (0, 0, sin(a/2), cos(a/2)) turns +x toward +y by a. The content
becomes the scene's, so that a job depends on it and a dataset holds it.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from synth.errors import InputError
from synth.untrusted import MOST_TEXT, read_file

POSE = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
HEADER = ("time_s", *POSE)
MOST_POSES = 1001
"""A state at rest and as many frames as a motion may have."""
UNIT = 1e-3
"""A quaternion's length is 1 within this: logs have rounded numbers."""
FAR_MM = 1000.0
"""No pose is farther off: it would be in another unit."""


def pose_problem(rows: Sequence[Sequence[float]]) -> tuple[int, str] | None:
    """The number of the first row that is no pose, or comes no later than the row before, and what is wrong with it."""
    time = -math.inf
    for number, row in enumerate(rows):
        if len(row) != len(HEADER) or not all(map(math.isfinite, row)):
            return number, f"a pose has {len(HEADER)} finite numbers: {', '.join(HEADER)}"
        if abs((length := math.hypot(*row[4:])) - 1) > UNIT:
            return number, f"the quaternion {list(row[4:])} has length {length:.4g}; that of a rotation has 1"
        if max(map(abs, row[1:4])) > FAR_MM:
            return number, f"the place {list(row[1:4])} is farther than {FAR_MM:g} mm off; places are in mm"
        if row[0] <= time:
            return number, f"time_s = {row[0]:g} does not come after {time:g}, the time of the pose before"
        time = row[0]
    return None if 2 <= len(rows) <= MOST_POSES else (len(rows), f"{len(rows)} poses; allowed are 2 to {MOST_POSES}")


def read_poses(path: Path) -> list[list[float]]:
    """The rows of a file of poses; InputError, with the number of the line, for what is none."""
    try:
        header, *lines = read_file(path, MOST_TEXT).decode("utf-8-sig").rstrip().split("\n")
    except (OSError, ValueError) as error:
        raise InputError(f"motion.poses: {path}: cannot be read: {error}") from error
    if [name.strip() for name in header.split(",")] != list(HEADER):
        raise InputError(f"motion.poses: {path}, line 1: the header is {header!r}; allowed is {','.join(HEADER)}")
    rows = [[_number(cell) for cell in line.split(",")] for line in lines]
    if problem := pose_problem(rows):
        raise InputError(f"motion.poses: {path}, line {problem[0] + 2}: {problem[1]}")
    return rows


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def with_poses(value: Any, folder: Path) -> Any:
    """A JSON-able part of a scene, in which motions by files of poses have the files' rows, and steps.

    A choice of files becomes a choice of motions.
    """
    if isinstance(value, list):
        return [with_poses(inner, folder) for inner in value]
    match value:
        case {"poses": str(file)}:
            rows = read_poses(folder / file)
            return {"steps": len(rows) - 1, **value, "poses": rows}
        case {"poses": {"choice": list(files)}}:
            return {"choice": [with_poses({**value, "poses": file}, folder) for file in files]}
        case dict():
            return {name: with_poses(inner, folder) for name, inner in value.items()}
    return value
