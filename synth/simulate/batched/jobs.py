"""Trajectories to be run, as tables for the device, and what comes back of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.batched.slots import COMPLETE, NO_BALANCE, Jobs
from synth.simulate.batched.sums import SCALARS
from synth.simulate.distance import shape_vector
from synth.simulate.load_path import LoadPath
from synth.simulate.press import Press
from synth.simulate.space import Space
from synth.simulate.tables import warp_array
from synth.simulate.trajectory import State, Trajectory, no_contact, not_converged, trajectory_of


@dataclass(frozen=True)
class Job:
    """One trajectory: its way, its friction, and its gel's Young's modulus in MPa."""

    path: LoadPath
    friction: float
    modulus_mpa: float

    @classmethod
    def of(cls, press: Press) -> "Job":
        """The job of a press."""
        return cls(press.path, press.scene.contact.friction, press.scene.sensor.gel.youngs_modulus_kpa / 1000)

    @property
    def touches(self) -> bool:
        """Whether the indenter ever goes below the undeformed surface."""
        return self.path.may_touch


@dataclass(frozen=True)
class Ended:
    """How a trajectory ended: reason code, path length reached, and where the next step would have led."""

    reason: int
    at: float
    target: float


def job_tables(
    jobs: Sequence[Job], size_mm: tuple[float, float, float], frames: Sequence[frozenset[int]] | None, d: str
) -> Jobs:
    """All jobs on device d. frames: numbers of each job's states that are to be corrected, default all."""
    paths = [job.path for job in jobs]
    corners, ends = _stacked([path.corners for path in paths]), _stacked([path.ends for path in paths])
    kinds = []
    for number, path in enumerate(paths):
        wanted = None if frames is None else frames[number]
        kind = {float(r): 2 if wanted is None or k in wanted else 1 for k, r in enumerate(path.records(), 1)}
        kinds.append(np.array([kind.get(float(stop), 0) for stop in path.waypoints()]))
    grids = _grids(paths)[1]
    table = Jobs()
    table.corners = warp_array(corners, wp.vec4d, d)
    table.ends = warp_array(ends, wp.float64, d)
    table.legs = warp_array(np.array([len(path.ends) for path in paths]), wp.int32, d)
    table.waypoints = warp_array(_stacked([path.waypoints() for path in paths]), wp.float64, d)
    table.kind_of = warp_array(_stacked(kinds), wp.int32, d)
    table.stops = warp_array(np.array([len(path.waypoints()) for path in paths]), wp.int32, d)
    table.press = warp_array(np.array([path.press_mm for path in paths]), wp.float64, d)
    deepest = [max(float(path.corners[:, 0].max()), 0.1) for path in paths]
    table.deepest = warp_array(np.array(deepest), wp.float64, d)
    table.over_pad = warp_array(np.array([path.is_over(size_mm) for path in paths]), wp.int32, d)
    table.position = warp_array(np.array([path.motion.position_mm for path in paths], dtype=np.float64), wp.vec2d, d)
    table.reach = warp_array(np.array([path.body.reach_mm - path.face_mm for path in paths]), wp.float64, d)
    table.rotation = warp_array(np.array([path.body.rotation for path in paths]), wp.mat33d, d)
    table.kind = warp_array(np.array([path.body.kind for path in paths]), wp.int32, d)
    table.grid = warp_array(np.array(grids), wp.int32, d)
    table.friction = warp_array(np.array([job.friction for job in jobs], dtype=np.float64), wp.float64, d)
    table.sharpness = warp_array(np.array([path.body.sharpness for path in paths]), wp.float64, d)
    return table


def body_tables(jobs: Sequence[Job], d: str) -> tuple[wp.array, wp.array, tuple[int, int, int]]:
    """Shapes (N,), distance grids (g, cells) of mesh indenters, each once, and the largest grid's counts."""
    grids = _grids([job.path for job in jobs])[0]
    counts = tuple(int(n) for n in np.max([grid.shape for grid in grids], axis=0))
    padded = np.zeros((len(grids), *counts))
    for place, grid in zip(padded, grids, strict=True):
        place[tuple(slice(0, n) for n in grid.shape)] = grid
    shapes = warp_array(np.array([job.path.body.shape for job in jobs]), shape_vector, d)
    return shapes, warp_array(padded.reshape(len(grids), -1), wp.float64, d), (counts[0], counts[1], counts[2])


def _grids(paths: Sequence[LoadPath]) -> tuple[list[FloatArray], list[int]]:
    """The different distance grids and the number of each path's."""
    numbers: dict[bytes, int] = {}
    grids: list[FloatArray] = []
    number: list[int] = []
    for path in paths:
        grid = path.body.coefficients
        key = grid.tobytes() + bytes(str(grid.shape), "ascii")
        if key not in numbers:
            numbers[key] = len(grids)
            grids.append(grid)
        number.append(numbers[key])
    return grids, number


def _stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of unequal lengths, filled up with zeros."""
    longest = max(len(array) for array in arrays)
    stacked = np.zeros((len(arrays), longest, *arrays[0].shape[1:]), dtype=arrays[0].dtype)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
    return stacked


def untouched(job: Job, space: Space) -> Trajectory:
    """Of an indenter that stays off: the gel stays as it is."""
    lengths = [0.0, *map(float, job.path.records())]
    rest = np.zeros(SCALARS + 3 * len(space.points) + 3 * len(space.surface_nodes))
    rest[9] = 1.0
    states = tuple(_state(job, length, rest, space) for length in lengths)
    return Trajectory(states, "complete", "", 0.0, space)


def trajectory(job: Job, records: FloatArray, ended: Ended, seconds: float, space: Space) -> Trajectory:
    """From the records (r, ...) that a slot wrote, see `synth.simulate.batched.sums.write`."""
    states = [untouched(job, space).states[0]]
    for length, record in zip(job.path.records(), records, strict=False):
        states.append(_state(job, float(length), record, space))
    return trajectory_of(tuple(states), _reason(job, ended), seconds, space)


def _reason(job: Job, ended: Ended) -> str:
    if ended.reason == COMPLETE:
        return ""
    if ended.reason == NO_BALANCE:
        return not_converged(ended.target - ended.at, job.path.pose(ended.at))
    return no_contact(ended.target)


def _state(job: Job, length: float, record: FloatArray, space: Space) -> State:
    pose, e, nodes = job.path.pose(length), job.modulus_mpa, len(space.points)
    end = SCALARS + 3 * nodes
    area = float(record[6])
    return State(
        depth_mm=pose.depth_mm,
        shear_mm=pose.shear_mm,
        twist_deg=pose.twist_deg,
        displacement=record[SCALARS:end].reshape(nodes, 3).copy(),
        traction=e * record[end:].reshape(-1, 3),
        force_n=(e * float(record[0]), e * float(record[1]), e * float(record[2])),
        torque_nmm=(e * float(record[3]), e * float(record[4]), e * float(record[5])),
        newton_iterations=int(record[11]),
        residual=float(record[8]),
        min_jacobian=float(record[9]),
        max_penetration_mm=float(record[10]),
        slip_ratio=float(record[7]) / area if area > 0 else 0.0,
    )
