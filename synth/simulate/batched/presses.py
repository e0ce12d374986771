"""Presses as tables for the device, and trajectories from what their lanes recorded."""

from collections.abc import Sequence

import numpy as np

from synth.arrays import FloatArray
from synth.simulate.batched.lanes import COMPLETE, NO_CONTACT, NO_EQUILIBRIUM, TOO_DEEP, Presses
from synth.simulate.batched.reductions import SCALARS
from synth.simulate.policy.multipliers import allowed_share
from synth.simulate.press import Press
from synth.simulate.space import Space
from synth.simulate.tables import struct_of
from synth.simulate.trajectory import State, Trajectory, at_rest, no_contact, not_converged, too_deep


def press_tables(
    presses: Sequence[Press], frames: Sequence[frozenset[int]] | None, d: str
) -> tuple[Presses, tuple[int, int, int]]:
    """All presses, of one pad, on Warp device d, and the counts of their largest distance grid.

    `frames` are the numbers of each press's states that are to be corrected, by default all.
    """
    paths = [press.path for press in presses]
    bodies = [path.body for path in paths]
    kinds = []
    for number, path in enumerate(paths):
        wanted = None if frames is None else frames[number]
        kind = {float(r): 2 if wanted is None or k in wanted else 1 for k, r in enumerate(path.records(), 1)}
        kinds.append(np.array([kind.get(float(stop), 0) for stop in path.waypoints()]))
    grids = {_grid_key(body.coefficients): body.coefficients for body in bodies}
    numbers = {key: number for number, key in enumerate(grids)}
    counts = tuple(int(n) for n in np.max([grid.shape for grid in grids.values()], axis=0))
    padded = np.zeros((len(grids), *counts))
    for room, grid in zip(padded, grids.values(), strict=True):
        room[tuple(slice(0, n) for n in grid.shape)] = grid
    size_mm = presses[0].mesh.size_mm
    columns = {
        "corners": _stacked([path.corners for path in paths]),
        "ends": _stacked([path.ends for path in paths]),
        "legs": [len(path.ends) for path in paths],
        "waypoints": _stacked([path.waypoints() for path in paths]),
        "kind_of": _stacked(kinds),
        "stops": [len(path.waypoints()) for path in paths],
        "press_end": [path.press_mm for path in paths],
        "deepest": [path.depth_scale_mm for path in paths],
        "over_pad": [path.is_over(size_mm) for path in paths],
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
    press: Press, records: FloatArray, ended: tuple[int, float, float], seconds: float, space: Space
) -> Trajectory:
    """The trajectory of a press that ran in a lane, `seconds` of the run being its share.

    `records` (r, ...) are what the lane wrote, see `synth.simulate.batched.reductions.write_record`; `ended` is the
    reason's code, the path length reached, and where the next step would have led, mm.
    """
    states = at_rest(press.path, space)
    for length, record in zip(press.path.records(), records, strict=False):
        states.append(_state(press, float(length), record, space))
    code, reached, target = ended
    reasons = {
        COMPLETE: "",
        NO_EQUILIBRIUM: not_converged(target - reached, press.path.pose(reached)),
        NO_CONTACT: no_contact(target),
        TOO_DEEP: too_deep(press.path.pose(target), allowed_share(press.path.body)),
    }
    return Trajectory(tuple(states), reasons[code], seconds, space)


def _state(press: Press, length: float, record: FloatArray, space: Space) -> State:
    pose, modulus_mpa = press.path.pose(length), press.scene.sensor.gel.youngs_modulus_kpa / 1000
    scalars, fields = record[:SCALARS].tolist(), record[SCALARS:]
    end = 3 * len(space.points)
    fx, fy, fz, mx, my, mz = (modulus_mpa * value for value in scalars[:6])
    touching, slipping, residual, smallest, deepest, iterations = scalars[6:]
    displacement = fields[:end].reshape(-1, 3).copy()
    return State(
        depth_mm=pose.depth_mm,
        shear_mm=pose.shear_mm,
        twist_deg=pose.twist_deg,
        displacement=displacement,
        traction=modulus_mpa * fields[end:].reshape(-1, 3),
        force_n=(fx, fy, fz),
        torque_nmm=(mx, my, mz),
        newton_iterations=int(iterations),
        residual=residual,
        min_jacobian=smallest,
        max_penetration_mm=deepest,
        slip_ratio=slipping / touching if touching > 0 else 0.0,
    )
