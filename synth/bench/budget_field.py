r"""The error of a field in the picture, and the files that fields are kept in.

Material points lie on a regular grid over the undeformed contact face, those of it that the camera sees at rest. With
P(X) where it sees a point and u, r a field and the reference's, a state's error is

.. math::  e = sqrt(<|P(X + u) - P(X + r)|²>)   in px,

the mean over the points that are in the picture in both states, by the same mirror or by none. One that has slid out
of the picture, or beyond the end of a mirror, has no image there: what a lens or mirror without end would show of it
says nothing about the picture, and a point of which one state is seen by a mirror and the other past it would count
with the distance of the two images, some 100 px. The error of a press is the largest of its judged states.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from synth.arrays import BoolArray, FloatArray
from synth.dataset.npz import encode_npz, read_npz
from synth.dataset.storage import replace_file
from synth.mesh.pad import face_height
from synth.optics import Optics
from synth.optics.camera import Paths
from synth.scene import Scene
from synth.simulate import Trajectory
from synth.simulate.probe import probe

GRID = (81, 67)
"""Points of the contact face along x and y, its edges among them."""
LEAST_SEEN = 0.75
"""Share of the points that must count in a state. Less of them would be another picture than the one that is judged;
the pads of the shipped scenes are dragged so far that up to 10 % of what was seen at rest slides out."""


def places(scene: Scene) -> FloatArray:
    """(n, 2) x and y, mm, of the grid's points that the camera sees on the undeformed face."""
    sizes = scene.sensor.gel.size_mm[:2]
    x, y = (np.linspace(-length / 2, length / 2, n) for length, n in zip(sizes, GRID, strict=True))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    camera, seen = scene.sensor.camera, Optics.of(scene.sensor).project(_at_rest(points, scene))
    inside = (seen > 0).all(axis=1) & (seen[:, 0] < camera.width) & (seen[:, 1] < camera.height)
    return np.asarray(points[inside])


def field(trajectory: Trajectory, frames: Sequence[int], points: FloatArray) -> FloatArray:
    """(k, n, 3) mm: displacement of points (n, 2) of the contact face in some of the states."""
    matrix = probe(trajectory.space, points)
    return np.array([matrix @ trajectory.states[frame].displacement for frame in frames])


def picture_errors(found: FloatArray, reference: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """(k,) px, and (k,) the share of the points that count: see the module.

    Both fields are (k, n, 3) mm at the points of `places`. An error is NaN where less than LEAST_SEEN of them counts.
    """
    optics, rest = Optics.of(scene.sensor), _at_rest(places(scene), scene)
    errors, shares = [], []
    for u, r in zip(found, reference, strict=True):
        path = optics.look(optics.project(rest + r)).path
        here, there = optics.project(rest + u, path), optics.project(rest + r, path)
        counts = _is_seen(optics, here, path) & _is_seen(optics, there, path)
        shares.append(counts.mean())
        distance = np.linalg.norm(here[counts] - there[counts], axis=1)
        errors.append(np.sqrt((distance**2).mean()) if shares[-1] >= LEAST_SEEN else np.nan)
    return np.array(errors), np.array(shares)


def _is_seen(optics: Optics, pixels: FloatArray, path: Paths) -> BoolArray:
    """(n,) whether pixels (n, 2) are in the picture, and show what is seen by these paths."""
    return np.asarray(optics.is_inside(pixels) & (optics.look(pixels).path == path) & (path >= 0))


def write_field(file: Path, points: FloatArray, frames: Sequence[int], displacement: FloatArray) -> None:
    """Keep a field in single precision, which is worth 1e-6 px.

    Raises:
        InputError: the storage refuses.
    """
    arrays = {
        "points": points.astype(np.float32),
        "frames": np.array(frames, dtype=np.int32),
        "displacement": displacement.astype(np.float32),
    }
    replace_file(file, encode_npz(arrays))


def read_field(file: Path) -> FloatArray:
    """(k, n, 3) mm.

    Raises:
        InputError: the file is missing or damaged.
    """
    return np.asarray(read_npz(file, ("displacement",))["displacement"], dtype=np.float64)


def _at_rest(points: FloatArray, scene: Scene) -> FloatArray:
    return np.column_stack([points, face_height(points, scene.sensor.gel.dome_radius_mm)])
