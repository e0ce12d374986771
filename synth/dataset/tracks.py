"""A clip's tables: `states.csv`, a row for each frame, and `markers.csv`, a row for each dot and frame.

Both are CSV with a header, numbers as short as they read back to the same float64. Units are in the columns' names;
x, y, u and v are px.

    frame, time_s          from 0 on
    depth_mm ... twist_deg the object's pose, as in the scene's [motion]; or x_mm ... qw, as in motion.poses
    fx_n ... tz_nmm        force and torque of the object on the gel, the scene's frame
    contact_area_mm2       of the deformed contact face
    slip_ratio             of that area, the part that slid in the last load step
    gross_slip             1 where all of it slid, else 0

A marker is a dot of the pattern that a camera sees in some frame, by one path (straight, or by a mirror): at (x, y) in
this frame, where it has moved by (u, v) since frame 0; visible is 1 where it is seen.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray
from synth.errors import InputError
from synth.scene import Scene
from synth.scene.pose_file import POSE as POSED
from synth.untrusted import read_file

STATES_FILE, MARKERS_FILE = "states.csv", "markers.csv"
POSE = ("depth_mm", "shear_x_mm", "shear_y_mm", "twist_deg")
WRENCH = ("fx_n", "fy_n", "fz_n", "tx_nmm", "ty_nmm", "tz_nmm")
MARKERS = ("id", "frame", "x", "y", "u", "v", "visible")
_WHOLE = ("id", "frame", "gross_slip", "visible")
_GROSS = 1 - 1e-6
"""Slip ratio from which all of the contact slides: areas are sums of weights, which round."""


def pose_columns(scene: Mapping[str, Any]) -> tuple[str, ...]:
    """The columns of the object's pose, of a scene as meta.json has it."""
    return POSED if scene["motion"].get("poses") else POSE


def states_columns(scene: Mapping[str, Any]) -> tuple[str, ...]:
    """All columns of states.csv."""
    return ("frame", "time_s", *pose_columns(scene), *WRENCH, "contact_area_mm2", "slip_ratio", "gross_slip")


def states_of(
    scene: Scene, solver: Sequence[Mapping[str, Any]], force_n: FloatArray, torque_nmm: FloatArray
) -> FloatArray:
    """Rows of states.csv, (frames, columns), from the solver's records and the wrench (frames, 3) of each frame."""
    rows, poses = [], scene.motion.poses
    for frame, (state, force, torque) in enumerate(zip(solver, force_n, torque_nmm, strict=True)):
        pressed = (state["depth_mm"], *state["shear_mm"], state["twist_deg"])
        at = poses[frame] if poses else (frame / scene.sampling.frames_per_second, *pressed)
        area, slip = state["contact_area_mm2"], state["slip_ratio"]
        rows.append((frame, *at, *force, *torque, area, slip, slip >= _GROSS))
    return np.array(rows, np.float64)


def encode_table(columns: Sequence[str], rows: Iterable[FloatArray]) -> bytes:
    """A table's file: equal numbers give equal bytes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        cells = zip(columns, row, strict=True)
        writer.writerow([int(value) if name in _WHOLE else float(value) + 0.0 for name, value in cells])
    return text.getvalue().encode("ascii")


def read_table(path: Path, columns: Sequence[str]) -> NDArray[Any]:
    """The rows of a table, a structured array with fields of its columns' names (int64 or float64).

    InputError where it is missing or damaged, or its columns are others.
    """
    try:
        header, *lines = csv.reader(io.StringIO(read_file(path).decode("ascii")))
        if header != list(columns):
            raise ValueError(f"its columns are {', '.join(header)}; {', '.join(columns)} are needed")
        kinds = [(name, np.int64 if name in _WHOLE else np.float64) for name in columns]
        return np.array([tuple(map(float, line)) for line in lines], dtype=kinds)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, csv.Error, OverflowError) as error:
        raise InputError(f"{path}: not a table of a clip ({error}); the file is damaged") from error
