"""Which dot of the grid each found dot is, and the camera and layout that put them there."""

import json
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from synth.arrays import FloatArray, Pixels
from synth.errors import InputError
from synth.optics import Optics
from synth.scene import Camera, Dots, Part, Sensor

_Part = TypeVar("_Part", bound=Part)
_FEWEST = 9
"""Dots that make a grid."""
_CENTRE, _TILT_MM, _K1 = 0.02, 1.0, 0.1
"""Standard deviations of the prior: of the principal point over the image's width, of look_at_mm, and of k1."""
_DOT_PX = 0.3
"""Distance of a dot from its grid that weighs as much as one standard deviation of the prior."""


@dataclass(frozen=True, eq=False)
class DotGridFit:
    """Layout and camera."""

    pattern: Dots  # with spacing, rotation, offset and jitter as found; its radius has grown with the spacing
    camera: Camera  # with focal lengths, principal point, tilt and k1 as found
    residual_px: Pixels  # (n, 2) found minus predicted centres
    used: NDArray[np.int64]  # (n,) indices of the found dots that are part of the grid
    index: NDArray[np.int64]  # (n, 2) their columns and rows
    pitch_px: float  # mean distance of columns and of rows


def fit_dot_grid(sensor: Sensor, pattern: Dots, centres: Pixels, spacing_mm: float | None) -> DotGridFit:
    """Fit the grid, and the camera as far as the grid tells; InputError where dots at `centres` (n, 2) px form none.

    A flat grid fixes the ratio of spacing and focal length alone. So either the spacing is known and the focal lengths
    are found, or the camera's scale is taken from the preset and the spacing is found. Principal point, tilt and the
    distortion k1 are weakly determined and held near the preset by a prior. The preset's camera has the frame's size.
    """
    used, index = grid_index(centres)
    start = _start(sensor, centres[used], index, spacing_mm)
    camera = sensor.camera

    def build(p: FloatArray) -> tuple[Dots, Camera]:
        scale = 1.0 if spacing_mm is None else float(np.exp(p[5]))
        columns = float(np.exp(p[0])) if spacing_mm is None else spacing_mm
        layout = {
            "spacing_mm": (columns, columns * float(np.exp(p[1]))),
            "radius_mm": pattern.radius_mm * columns / pattern.spacing_mm[0],
            "rotation_deg": float(np.degrees(p[2])),
            "offset_mm": (float(p[3]), float(p[4])),
        }
        view = {
            "fx": camera.fx * scale,
            "fy": camera.fy * scale,
            "cx": camera.cx + _CENTRE * camera.width * float(p[6]),
            "cy": camera.cy + _CENTRE * camera.width * float(p[7]),
            "look_at_mm": tuple(np.add(camera.look_at_mm, [_TILT_MM * p[8], _TILT_MM * p[9], 0.0]).tolist()),
        }
        if camera.lens == "pinhole":
            view["distortion"] = (camera.distortion[0] + _K1 * float(p[10]), *camera.distortion[1:])
        return pattern.model_copy(update=layout), camera.model_copy(update=view)

    def misfit(p: FloatArray) -> FloatArray:
        miss = _predicted(sensor, *build(p), index) - centres[used]
        return np.concatenate([np.nan_to_num(miss, nan=1e3).ravel() / _DOT_PX, p[6:]])

    found = least_squares(misfit, start, loss="soft_l1", f_scale=3.0, x_scale=np.maximum(np.abs(start), 0.05))
    layout, fitted = build(found.x)
    residual = centres[used] - _predicted(sensor, layout, fitted, index)
    corner = _predicted(sensor, layout, fitted, np.array([[1, 0], [0, 0], [0, 1]]))
    arms = np.linalg.norm(np.diff(corner, axis=0), axis=1)  # of columns and of rows
    jitter = 1.4826 * float(np.median(np.abs(residual)) / np.mean(arms / layout.spacing_mm))
    layout = _near_centre(layout.model_copy(update={"jitter_mm": round(jitter, 4)}))
    return DotGridFit(_rounded(layout), _rounded(fitted), residual, used, index, float(arms.mean()))


def grid_index(centres: Pixels) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Dots of a grid whose rows are within 40 degrees of horizontal: which (k,), and their column and row (k, 2).

    InputError where they form none.
    """
    tree = cKDTree(centres)
    arms = (centres[tree.query(centres, k=min(5, len(centres)))[1][:, 1:]] - centres[:, None]).reshape(-1, 2)
    arms = np.where((arms.sum(1) < 0)[:, None], -arms, arms)
    angle = np.degrees(np.arctan2(arms[:, 1], arms[:, 0]))
    flat, steep = arms[np.abs(angle) < 40], arms[np.abs(angle - 90) < 40]
    if len(flat) < _FEWEST or len(steep) < _FEWEST:
        raise InputError("the dots found in the frame form no grid of rows and columns; take a preset without dots")
    right, down = np.median(flat, axis=0), np.median(steep, axis=0)
    first = int(np.argmin(((centres - centres.mean(axis=0)) ** 2).sum(axis=1)))
    place = {first: (0, 0)}
    waiting = [first]
    while waiting:
        dot = waiting.pop(0)
        for column, row in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            distance, other = tree.query(centres[dot] + column * right + row * down)
            if distance < 0.3 * np.linalg.norm(right) and other not in place:
                place[int(other)] = (place[dot][0] + column, place[dot][1] + row)
                waiting.append(int(other))
    if len(place) < _FEWEST:
        raise InputError(f"only {len(place)} of {len(centres)} dots form a grid of rows and columns")
    if len(set(place.values())) < len(place):
        raise InputError("rows and columns of the dots run into each other: the gel is pressed; give frames at rest")
    used = np.array(sorted(place), dtype=np.int64)
    return used, np.array([place[int(k)] for k in used], dtype=np.int64)


def _start(sensor: Sensor, centres: Pixels, index: NDArray[np.int64], spacing_mm: float | None) -> FloatArray:
    """First guess from the points at which the preset's camera sees the dots."""
    points = Optics.of(sensor).look(centres).on_flat_face[:, :2]
    if not np.isfinite(points).all():
        raise InputError("the preset's camera does not see the gel where the frame shows dots; check sensor.camera")
    design = np.column_stack([index, np.ones(len(index))])
    right, down, offset = np.linalg.lstsq(design, points, rcond=None)[0]
    columns, rows = np.linalg.norm(right), np.linalg.norm(down)
    scale = 0.0 if spacing_mm is None else np.log(columns / spacing_mm)
    shrink = np.exp(-scale)
    start = [np.log(columns * shrink), np.log(rows / columns), np.arctan2(right[1], right[0]), *(offset * shrink)]
    return np.array([*start, scale, 0, 0, 0, 0, 0], dtype=np.float64)


def _predicted(sensor: Sensor, pattern: Dots, camera: Camera, index: NDArray[np.int64]) -> Pixels:
    view = sensor.model_copy(update={"camera": camera})
    return Optics.of(view).project(pattern_points(pattern, index))


def pattern_points(pattern: Dots, index: NDArray[np.int64]) -> FloatArray:
    """Places (n, 3) mm of a grid's dots without their jitter, on the undeformed contact face."""
    angle = np.radians(pattern.rotation_deg)
    along, across = index.T * np.array(pattern.spacing_mm)[:, None]
    x = pattern.offset_mm[0] + along * np.cos(angle) - across * np.sin(angle)
    y = pattern.offset_mm[1] + along * np.sin(angle) + across * np.cos(angle)
    return np.column_stack([x, y, np.zeros(len(index))])


def _rounded(part: _Part) -> _Part:
    """The same part with 6 decimals, which are fit to read: a thousandth of what a frame tells."""
    content = json.loads(part.model_dump_json(), parse_float=lambda text: round(float(text), 6))
    return type(part).model_validate(content)


def _near_centre(pattern: Dots) -> Dots:
    """The same grid with its dot nearest to the pad's centre as the first."""
    index = np.stack(np.meshgrid(np.arange(-40, 41), np.arange(-40, 41)), axis=-1).reshape(-1, 2)
    points = pattern_points(pattern, index)
    nearest = points[np.argmin((points**2).sum(axis=1))]
    return pattern.model_copy(update={"offset_mm": (float(nearest[0]), float(nearest[1]))})
