"""Presses as tables for the device, and trajectories from what their lanes recorded."""

from collections.abc import Sequence

import numpy as np

from synth.arrays import FloatArray
from synth.press.press import Press
from synth.simulate.batched.lanes import Presses
from synth.simulate.batched.reductions import SCALARS
from synth.simulate.policy.requests import Record
from synth.simulate.space import Space
from synth.simulate.tables import struct_of
from synth.simulate.trajectory import State, Trajectory, at_rest


def press_tables(presses: Sequence[Press], d: str) -> tuple[Presses, tuple[int, int, int]]:
    """All presses, of one pad, on Warp device d, and the counts of their largest distance grid."""
    paths = [press.path for press in presses]
    bodies = [path.body for path in paths]
    grids = {_grid_key(body.coefficients): body.coefficients for body in bodies}
    numbers = {key: number for number, key in enumerate(grids)}
    counts = tuple(int(n) for n in np.max([grid.shape for grid in grids.values()], axis=0))
    padded = np.zeros((len(grids), *counts))
    for room, grid in zip(padded, grids.values(), strict=True):
        room[tuple(slice(0, n) for n in grid.shape)] = grid
    columns = {
        "corners": _stacked([path.corners for path in paths]),
        "ends": _stacked([path.ends for path in paths]),
        "legs": [len(path.ends) for path in paths],
        "origin": [np.zeros(3) if path.frame is None else path.frame.origin for path in paths],
        "axes": [np.eye(3) if path.frame is None else path.frame.axes for path in paths],
        "position": [path.motion.position_mm for path in paths],
        "reach": [path.body.reach_mm - path.face_mm for path in paths],
        "rotation": [body.rotation for body in bodies],
        "kind": [body.kind for body in bodies],
        "shape": [body.shape for body in bodies],
        "grid": [numbers[_grid_key(body.coefficients)] for body in bodies],
        "grids": padded.reshape(len(grids), -1),
        "friction": [press.scene.contact.friction for press in presses],
        "sharpness": [press.scene.numerics.penalty * press.path.body.sharpness for press in presses],
    }
    return struct_of(Presses, d, **columns), (counts[0], counts[1], counts[2])


def _grid_key(grid: FloatArray) -> tuple[bytes, tuple[int, ...]]:
    return grid.tobytes(), grid.shape


def _stacked(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of unequal lengths, filled up with zeros."""
    longest = max(len(array) for array in arrays)
    stacked = np.zeros((len(arrays), longest, *arrays[0].shape[1:]), dtype=arrays[0].dtype)
    for row, array in zip(stacked, arrays, strict=True):
        row[: len(array)] = array
    return stacked


def trajectory(
    press: Press, told: Sequence[Record], fields: FloatArray, reason: str, seconds: float, space: Space
) -> Trajectory:
    """The trajectory of a press that ran in a lane, `seconds` of the run being its share.

    `told` is what its policy recorded and `fields` (r, ...) what the lane wrote, see
    `synth.simulate.batched.reductions.write_record`.
    """
    states = at_rest(press.path, space)
    states += [_state(press, record, row, space) for record, row in zip(told, fields, strict=True)]
    return Trajectory(tuple(states), reason, seconds, space)


def _state(press: Press, told: Record, row: FloatArray, space: Space) -> State:
    pose, modulus_mpa = press.path.pose(told.at_mm), press.scene.sensor.gel.youngs_modulus_kpa / 1000
    scalars, fields = row[:SCALARS].tolist(), row[SCALARS:]
    end = 3 * len(space.points)
    fx, fy, fz, mx, my, mz = (modulus_mpa * value for value in scalars[:6])
    touching, slipping = scalars[6:]
    return State(
        depth_mm=pose.depth_mm,
        shear_mm=pose.shear_mm,
        twist_deg=pose.twist_deg,
        displacement=fields[:end].reshape(-1, 3).copy(),
        traction=modulus_mpa * fields[end:].reshape(-1, 3),
        force_n=(fx, fy, fz),
        torque_nmm=(mx, my, mz),
        newton_iterations=told.iterations,
        residual=told.evaluation.relative,
        min_jacobian=told.evaluation.smallest_jacobian,
        max_penetration_mm=told.evaluation.deepest_mm,
        slip_ratio=slipping / touching if touching > 0 else 0.0,
    )
