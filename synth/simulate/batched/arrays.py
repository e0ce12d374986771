"""The arrays of a batch: the state of its lanes, their fields, contact, and the linear solver's vectors.

At 512 lanes of an 11,500-unknown P2/P1 mesh they take some 7 GB, most of it contact's memory and the Krylov basis.
"""

from collections.abc import Callable
from typing import Any

import warp as wp

from synth.simulate.batched.fields import ContactMemory, Fields
from synth.simulate.batched.krylov import Krylov, flat, shapes
from synth.simulate.batched.lanes import Lanes
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.product import STORED, STORED_YEOH
from synth.simulate.batched.reductions import SCALARS
from synth.simulate.contact import ContactState, Indenters


def _filled(struct: Any, shape: Callable[[str], tuple[int, ...]], device: str) -> Any:
    """A Warp struct whose arrays are zeros; shape of each by its name."""
    made = struct()
    for name, variable in struct.vars.items():
        setattr(made, name, wp.zeros(shape(name), dtype=variable.type.dtype, device=device))
    return made


class BatchArrays:
    """Arrays of zeros for so many lanes, see the module's docstring.

    A trajectory records at most `records` states; the largest distance grid of the indenters has the counts `grid`.
    """

    def __init__(self, pad: Pad, batch: int, records: int, grid: tuple[int, int, int]) -> None:
        space, device = pad.space, pad.device

        def zeros(shape: int | tuple[int, ...], dtype: Any) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=device)

        nodes, pressures, elements = len(space.points), space.pressures if pad.mixed else 0, len(space.nodes)
        self.points = (batch, len(space.faces), len(space.element.face_weights))
        self.lanes: Lanes = _filled(Lanes, lambda _: (batch,), device)
        self.fields: Fields = _filled(Fields, lambda n: (batch, nodes if n.endswith("_u") else pressures), device)
        self.contact: ContactState = _filled(ContactState, lambda _: self.points, device)
        self.saved: ContactMemory = _filled(ContactMemory, lambda _: self.points, device)
        self.force, self.volume = zeros((batch, nodes), wp.vec3d), zeros((batch, pressures), wp.float64)
        self.viscous = zeros((batch, nodes), wp.vec3d)
        self.jacobian = zeros((batch, elements), wp.float64)
        self.gap, self.tangential = zeros(self.points, wp.float64), zeros(self.points, wp.vec3d)
        self.memory = ContactMemory()
        self.memory.gap, self.memory.tangential = self.gap, self.tangential
        for name in ("normal", "tangent", "anchor", "anchored"):
            setattr(self.memory, name, getattr(self.contact, name))
        self.traction = zeros(self.points, wp.vec3d)
        self.normal_before, self.tangent_before = zeros(self.points, wp.float64), zeros(self.points, wp.vec3d)
        self.indenters: Indenters = _filled(
            Indenters, lambda name: (batch, *grid) if name == "coefficients" else (batch,), device
        )
        self.records = zeros((batch, records, SCALARS + 3 * nodes + 3 * len(space.surface_nodes)), wp.float64)
        self.sums = zeros((batch, 8), wp.float64)
        self.mask, self.begun, self.assignment = (zeros(batch, wp.int32) for _ in range(3))
        stored = (elements, len(space.element.weights), STORED_YEOH if pad.yeoh else STORED, batch)
        self.stored = zeros(stored, wp.float32)
        self.inverting = zeros((elements, batch), wp.int32)
        self.touching, self.touched = zeros(self.points[:2], wp.int32), zeros(self.points[:2], wp.int32)
        self.symmetric, self.remainder = zeros(self.points, wp.mat33d), zeros(self.points, wp.mat33d)
        self.stored_contact = zeros(self.points, wp.mat33f)
        sizes = shapes(pad.preconditioner.rows, batch)
        self.krylov: Krylov = _filled(Krylov, lambda name: sizes[name], device)
        self.step = flat(self.krylov.step)
