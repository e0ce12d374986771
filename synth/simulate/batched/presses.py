"""Presses as tables for the device, and trajectories from what their lanes recorded."""

from collections.abc import Sequence

import numpy as np

from synth.arrays import FloatArray
from synth.press.distance import SHAPE_LENGTH
from synth.press.press import Press
from synth.simulate.batched.lane_orders import Presses
from synth.simulate.batched.reductions import SCALARS
from synth.simulate.policy.requests import Record
from synth.simulate.space import Space
from synth.simulate.tables import struct_of
from synth.simulate.trajectory import State, Trajectory, at_rest


class PressTable:
    """The presses in the lanes, by columns; row s is lane s's.

    `kind` (B,) and `shape` (B, k) are of the bodies, see `synth.simulate.contact_friction.Indenters`.
    """

    def __init__(self, batch: int, device: str) -> None:
        self._device = device
        self.kind, self.shape = np.zeros(batch, dtype=np.int32), np.zeros((batch, SHAPE_LENGTH))
        widths: dict[str, tuple[int, ...]] = {
            "corners": (2, 4), "ends": (2,), "origin": (3,), "axes": (3, 3), "position": (2,), "reach": (),
            "rotation": (3, 3), "friction": (),
        }  # fmt: skip
        self._columns: dict[str, np.ndarray] = {name: np.zeros((batch, *width)) for name, width in widths.items()}
        self._columns["ends"][:, 1] = np.inf

    def put(self, lane: int, press: Press) -> None:
        """A press begins in a lane."""
        columns, path = self._columns, press.path
        body, corners = path.body, len(path.ends)
        self.kind[lane], self.shape[lane] = body.kind, body.shape
        for name, values, behind in (("corners", path.corners, 0.0), ("ends", path.ends, np.inf)):
            more = corners + 1 - columns[name].shape[1]
            if more > 0:
                widths = [(0, 0), (0, more), (0, 0)][: columns[name].ndim]
                columns[name] = np.pad(columns[name], widths, constant_values=behind)
            columns[name][lane] = behind
            columns[name][lane, :corners] = values
        row = {
            "origin": np.zeros(3) if path.frame is None else path.frame.origin,
            "axes": np.eye(3) if path.frame is None else path.frame.axes,
            "position": path.motion.position_mm,
            "reach": body.reach_mm - path.face_mm,
            "rotation": body.rotation,
            "friction": press.scene.contact.friction,
        }
        for name, value in row.items():
            columns[name][lane] = value

    def on_device(self) -> Presses:
        """A copy for kernels."""
        return struct_of(Presses, self._device, **self._columns)


def padded(array: np.ndarray, shape: Sequence[int]) -> np.ndarray:
    """Zeros behind the numbers of an array."""
    whole = np.zeros(shape, dtype=array.dtype)
    whole[tuple(slice(0, n) for n in array.shape)] = array
    return whole


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
    end = SCALARS + 3 * len(space.points)
    loads = row[:3], row[3:6], row[end:].reshape(-1, 3)
    touching, slipping = row[6:SCALARS].tolist()
    ratio = slipping / touching if touching > 0 else 0.0
    modulus_mpa = press.scene.sensor.gel.youngs_modulus_kpa / 1000
    displacement = row[SCALARS:end].reshape(-1, 3).copy()
    return State.of(told, press.path.pose(told.at_mm), displacement, loads, modulus_mpa, ratio)
