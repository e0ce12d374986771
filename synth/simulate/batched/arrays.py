"""The arrays of a batch: the state of its lanes, their fields, contact, the linear solver's vectors, and tables for it.

Rows of the vectors: three for each free node's displacement, then the pressures, then rows that fill up, which stay
zero. Most of the memory is contact's and the Krylov basis.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from synth.simulate.batched.fields import ContactMemory, Fields
from synth.simulate.batched.krylov import Krylov, flat, waiting
from synth.simulate.batched.lane_orders import Number, Seen
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.product import STORED, STORED_YEOH, SingleTables
from synth.simulate.batched.reductions import SCALARS
from synth.simulate.bulk import Bulk
from synth.simulate.contact_friction import ContactState, Indenters
from synth.simulate.space import Space
from synth.simulate.tables import struct_of, zeros_of


class BatchArrays:
    """Arrays of zeros for so many lanes, see the module's docstring.

    A trajectory records at most `records` states; the largest distance grid of the indenters has the counts `grid`.
    """

    def __init__(self, pad: Pad, batch: int, records: int, grid: tuple[int, int, int]) -> None:
        space, device = pad.space, pad.device

        def zeros(shape: int | tuple[int, ...], dtype: Any) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        self.nodes, elements = len(space.points), len(space.nodes)
        values = (batch, 3 * self.nodes + (space.pressures if pad.mixed else 0))
        self.points = (batch, len(space.faces), len(space.element.face_weights))
        self.orders, self.numbers = zeros(batch, wp.int32), zeros((batch, len(Number)), wp.float64)
        self.seen = zeros((batch, Seen.FORCE + SCALARS), wp.float64)
        self.sums = self.seen[:, Seen.FORCE :]
        columns = Number.VISCOSITY, Number.TURN, Number.STIFFNESS
        self.viscosity, self.turn, self.stiffness = (self.numbers[:, n] for n in columns)
        self.asked_share, self.share = self.numbers[:, Number.SHARE], zeros(batch, wp.float64)
        self.fields: Fields = zeros_of(Fields, lambda _: values, device)
        self.residual, self.viscous = zeros(values, wp.float64), zeros(values, wp.float64)
        self.state, self.iterate, self.trial, self.forces, self.viscous_forces = (
            by_node(each, self.nodes)
            for each in (self.fields.state, self.fields.iterate, self.fields.trial, self.residual, self.viscous)
        )
        self.contact: ContactState = zeros_of(ContactState, lambda _: self.points, device)
        self.after_step, self.before_pass = (zeros_of(ContactMemory, lambda _: self.points, device) for _ in range(2))
        self.jacobian = zeros((batch, elements), wp.float64)
        self.gap, self.tangential = zeros(self.points, wp.float64), zeros(self.points, wp.vec3d)
        self.gaps = self.gap.reshape((batch, -1))
        self.memory = ContactMemory()
        self.memory.gap, self.memory.tangential = self.gap, self.tangential
        for name in ("normal", "tangent", "anchor", "anchored"):
            setattr(self.memory, name, getattr(self.contact, name))
        self.traction = zeros(self.points, wp.vec3d)
        self.indenters: Indenters = zeros_of(
            Indenters, lambda name: (batch, *grid) if name == "coefficients" else (batch,), device
        )
        self.records = zeros((batch, records, SCALARS + 3 * self.nodes + 3 * len(space.surface_nodes)), wp.float64)
        self.mask = zeros(batch, wp.int32)
        stored = (elements, len(space.element.weights), STORED_YEOH if pad.yeoh else STORED, batch)
        self.stored = zeros(stored, wp.float32)
        self.inverting = zeros((elements, batch), wp.int32)
        self.touching = zeros(self.points[:2], wp.int32)
        self.symmetric, self.remainder = zeros(self.points, wp.mat33d), zeros(self.points, wp.mat33d)
        self.stored_contact = zeros(self.points, wp.mat33f)
        self.krylov: Krylov = waiting(len(pad.inverse), batch, device)
        self.step = flat(self.krylov.step)


class ByNode(NamedTuple):
    """Views of values (B, 3 n + k): displacements, or forces, `u` (B, n) of vec3d, and `p` (B, k)."""

    u: wp.array
    p: wp.array


def by_node(values: wp.array, nodes: int) -> ByNode:
    """These views, which do not keep the values alive."""
    lanes, pressures = len(values), values.shape[1] - 3 * nodes
    row, device = values.strides[0], values.device
    u = wp.array(ptr=values.ptr, dtype=wp.vec3d, shape=(lanes, nodes), strides=(row, 24), device=device)
    p = wp.array(
        ptr=values.ptr + 24 * nodes, dtype=wp.float64, shape=(lanes, pressures), strides=(row, 8), device=device
    )
    return ByNode(u, p)


def single_tables(space: Space, free: np.ndarray, rows: int, bulk: Bulk, device: str) -> SingleTables:
    """Number the free unknowns (k,), displacements first, of a space in vectors of so many rows.

    ValueError where a node is held in some directions only.
    """
    nodes, mixed = len(space.points), bool(bulk.mixed)
    row = np.full(3 * nodes + (space.pressures if mixed else 0), -1, dtype=np.int32)
    row[free] = np.arange(len(free))
    moving, pressure_row = row[: 3 * nodes].reshape(nodes, 3), row[3 * nodes :]
    if not ((moving >= 0).all(axis=1) | (moving < 0).all(axis=1)).all():
        raise ValueError("a batch needs nodes that are held in all directions or in none")
    tables = {
        "unknown": np.pad(free, (0, rows - len(free)), constant_values=-1),
        "row": row,
        "element_row": moving[space.nodes, 0],
        "pressure_row": pressure_row[space.pressure_nodes] if mixed else np.zeros((0, 4)),
        "face_row": moving[space.faces, 0],
        "face_shape": space.element.face_shape,
        **{name: getattr(bulk, name).numpy() for name in ("gradient", "pressure_shape", "stabilisation")},
    }
    return struct_of(SingleTables, device, **tables)
