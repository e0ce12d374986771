"""A batch of slots on one device, and the cycle of kernels that takes all of them on.

A cycle takes up the linear solves that are done, tries their directions, lets every slot decide what is next, begins
linear solves, and does INNER Krylov iterations of all that are running. It is the same sequence of launches each time,
whatever the slots are at, so that on CUDA it is captured once as a graph; the host only asks which slots have ended.

On a CPU a trajectory's bits depend neither on its neighbours nor on its slot. On a GPU residuals and products are added
up by atomic operations in any order and cuBLAS chooses its algorithm by the size of the batch, so that the last bits of
a Newton iterate change from run to run even for the same batch; what converges meets Newton's tolerance, but may be
another balance (docs/reports/batched_fem.md, Rounding).
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.batched import fields as moves
from synth.simulate.batched import krylov as gmres
from synth.simulate.batched import slots as phases
from synth.simulate.batched import sums
from synth.simulate.batched.decisions import bear, choose_pass, conclude, control, judge, recorded
from synth.simulate.batched.folding import find_folding, fold_product
from synth.simulate.batched.numbering import number_rows, surface_tables
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.placing import NUDGE, place, refill, take_grids
from synth.simulate.batched.product import BLOCK, bulk_product, contact_product, store, store_contact
from synth.simulate.batched.storage import Storage
from synth.simulate.bulk import bulk_residual
from synth.simulate.contact import contact_residual, contact_stiffness
from synth.simulate.fold import fold_residual
from synth.simulate.multipliers import augment, update_contact_history
from synth.simulate.stiffness import viscous_force
from synth.simulate.tables import bulk_tables, face_tables, fold_tables

INNER = 8
"""Krylov iterations of a cycle: a solve that ends within them waits for their end, on average half of them."""
ROUNDS = 2
"""Trials of the line search in a cycle; a slot that needs more goes on in the next."""


class Machine:
    """See the module's docstring.

    Args:
        pad: what the slots share.
        batch: number of slots.
        records: most states that a trajectory records.
        grid: counts of the largest distance grid of the indenters.
        settings: of Newton's method and of stepping.
        penalty: contact stiffness, E per mm.
        inner: Krylov iterations of a cycle.
    """

    def __init__(
        self,
        pad: Pad,
        batch: int,
        records: int,
        grid: tuple[int, int, int],
        settings: phases.Settings,
        penalty: float,
        inner: int = INNER,
    ) -> None:
        space, material, device = pad.space, pad.material, pad.device
        self.pad, self.batch, self.device, self.penalty, self.settings = pad, batch, device, penalty, settings
        mixed, yeoh = material.mixed and space.element.has_pressure, bool(material.yeoh.any())
        rows = pad.reference.rows
        self._bulk, self._faces = bulk_tables(space, material, mixed, device), face_tables(space, device)
        self.inner = inner
        self._lattice = fold_tables(space, material, device)
        self._rows = number_rows(space, pad.free, rows, self._bulk, device)
        self._surface = surface_tables(space, self._faces.weight.numpy(), device)
        stabilised = space.element.stabilisation > 0
        self._product = bulk_product(space.nodes.shape[1], mixed, stabilised, yeoh)
        self._contact_product = contact_product(space.faces.shape[1])
        self._block = gmres.block_size(rows)
        self._arnoldi, self._solution = gmres.arnoldi(rows), gmres.solution(rows)
        self._at = Storage(space, mixed, yeoh, rows, batch, records, grid, device)
        self.slots, self.krylov = self._at.slots, self._at.krylov
        self._vectors = (batch, rows // 4)
        self._right = gmres.plain(self.krylov.basis)
        self._each = (batch, len(space.points) + self._at.volume.shape[1])
        self.watch: Callable[[str, str], None] = lambda part, kernel: None
        """Called after each launch with the part of the cycle and the kernel's name, for profiles."""
        self._part = ""

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], *arguments: Any, block: int = 256) -> None:
        wp.launch(kernel, dim, inputs=list(arguments), device=self.device, block_dim=block)
        self.watch(self._part, kernel.key)

    def _launch_blocks(self, kernel: wp.Kernel, block: int, *arguments: Any) -> None:
        """One block of so many threads per slot."""
        wp.launch_tiled(kernel, dim=[self.batch], inputs=list(arguments), block_dim=block, device=self.device)
        self.watch(self._part, kernel.key)

    def _select(self, *wanted: int) -> None:
        at = self._at
        self._launch(phases.select, self.batch, self.slots, phases.bits(*wanted), at.mask)

    def _place(self, jobs: phases.Jobs) -> None:
        at = self._at
        self._launch(place, self.batch, self.slots, jobs, at.indenters)

    def cycle(self, jobs: phases.Jobs) -> None:
        """Queue one cycle of all slots."""
        self._take_up()
        for _ in range(ROUNDS):
            self._evaluate(jobs)
        self._advance(jobs)
        self._evaluate(jobs)
        self._linearise(jobs)
        for _ in range(self.inner):
            self._iterate()

    def _take_up(self) -> None:
        """Solutions of the linear solves that are done."""
        at = self._at
        k, self._part = at.krylov, "krylov"
        self._launch_blocks(self._solution, self._block, self.slots, k, at.begun)
        self._launch(gmres.rest, self.batch, k)
        where = (self._rows.node_row, self._rows.pressure_row, at.fields)
        self._launch(moves.carry, self._each, at.begun, NUDGE, at.step, *where)

    def _evaluate(self, jobs: phases.Jobs) -> None:
        """Residuals of all slots that wait for one, and what follows from them."""
        at, self._part = self._at, "residual"
        s, f, mask = self.slots, at.fields, at.mask
        elements = (self.batch, len(self.pad.space.nodes))
        self._place(jobs)
        self._select(phases.FRESH, phases.START, phases.SEARCH, phases.REPAIR, phases.NUDGED)
        where = (self._rows.node_row, self._rows.pressure_row)
        self._launch(moves.attempt, self._each, s, mask, at.step, *where, f, at.force, at.viscous, at.volume)
        residual = (at.force, at.volume, at.jacobian)
        self._launch(bulk_residual, elements, f.trial_u, f.trial_p, mask, self._bulk, *residual)
        if self._lattice is not None:
            self._launch(fold_residual, elements, f.trial_u, mask, self._lattice, at.force, at.jacobian)
        found = (at.force, at.gap, at.tangential, at.traction)
        law = (self._faces, at.indenters, at.contact, self.penalty)
        self._launch(contact_residual, at.points[:2], f.trial_u, mask, *law, *found)
        self._launch_blocks(sums.norms, sums.BLOCK, mask, *residual, self._rows.node_row, f, s)
        self._launch(viscous_force, elements, mask, f.iterate_u, f.trial_u, s.viscosity, self._bulk, at.viscous)
        moved = (at.force, at.viscous, at.volume, *where, self._right)
        self._launch_blocks(sums.relaxation_errors, sums.BLOCK, mask, *moved, s)
        self._launch(judge, self.batch, s, self.settings)
        self._launch(moves.move, self._each, s, 0, f)

    def _advance(self, jobs: phases.Jobs) -> None:
        """Slots whose Newton solve ended: accept, correct, record, and choose the next step."""
        at, self._part = self._at, "stepping"
        s, f, memory = self.slots, at.fields, (at.contact, at.gap, at.tangential)
        self._launch(conclude, self.batch, s, jobs, self.settings)
        self._launch(moves.move, self._each, s, phases.bits(phases.TOUCHED, phases.PASSING), f)
        multipliers = (at.normal_before, at.tangent_before)
        self._launch(moves.undo_multipliers, at.points, s, *multipliers, at.contact)
        self._sum(phases.TOUCHED)
        self._launch(bear, self.batch, s, jobs, at.sums)
        self._launch(moves.keep, at.points, s.keep, *memory, at.kept)
        self._settle(s.anchor, 1)
        self._select(phases.PASSING)
        self._launch(sums.blank, (self.batch, 8), at.mask, s, at.sums)
        self._launch(sums.depths, at.points[:2], at.mask, at.gap, s)
        self._launch(choose_pass, self.batch, s, jobs, self.settings)
        self._launch(moves.remember_multipliers, at.points, s, at.contact, *multipliers)
        found = (at.gap, at.tangential, self.penalty)
        self._launch(augment, at.points, s.share_now, at.indenters, *found, at.contact)
        self._record()
        self._select(phases.ADVANCE, phases.FIRST)
        self._settle(at.mask, 0)
        self._launch(control, self.batch, s, jobs, self.settings)
        self._launch(moves.move, self._each, s, 0, f)

    def _sum(self, phase: int) -> None:
        """Forces and penetration of slots in a phase."""
        at = self._at
        self._select(phase)
        mask = at.mask
        self._launch(sums.blank, (self.batch, 8), mask, self.slots, at.sums)
        self._launch(sums.depths, at.points[:2], mask, at.gap, self.slots)
        found = (at.fields.iterate_u, self._faces, at.indenters, at.traction, at.tangential)
        self._launch(sums.forces, at.points[:2], mask, *found, at.sums)

    def _settle(self, mask: wp.array, new_only: int) -> None:
        at = self._at
        found = (self._faces, at.indenters, at.gap, at.tangential, self.penalty, new_only, at.contact)
        self._launch(update_contact_history, at.points, at.fields.state_u, mask, *found)

    def _record(self) -> None:
        at = self._at
        s, nodes, surface = self.slots, len(self.pad.space.points), len(self.pad.space.surface_nodes)
        self._sum(phases.RECORD)
        self._launch(sums.write, (self.batch, nodes), at.mask, s, at.fields.iterate_u, at.sums, surface, at.records)
        where = (self._surface.hat, self._surface.number, self._surface.area, at.traction, nodes)
        self._launch(sums.write_tractions, at.points[:2], at.mask, s, self._faces, *where, at.records)
        memory = (at.contact, at.gap, at.tangential)
        self._select(phases.RECORD, phases.BACK)
        self._launch(moves.recall, at.points, at.mask, s, at.kept, *memory)
        self._launch(recorded, self.batch, s)

    def _linearise(self, jobs: phases.Jobs) -> None:
        """Tangents of all slots that are ready for a linear solve, and its begin."""
        at, self._part = self._at, "tangent"
        f, mask = at.fields, at.mask
        self._place(jobs)
        self._select(phases.READY, phases.CARRY_READY)
        elements = (len(self.pad.space.nodes), self.batch)
        self._launch(store, elements, mask, f.iterate_u, f.iterate_p, self._bulk, self.slots.viscosity, at.stored)
        if self._lattice is not None:
            self._launch(find_folding, elements, mask, f.iterate_u, self._lattice, at.folding)
        law = (self._faces, at.indenters, at.contact, self.penalty)
        matrices = (at.symmetric, at.remainder)
        self._launch(contact_stiffness, at.points[:2], f.iterate_u, mask, *law, at.touching, *matrices)
        stored = (at.stored_contact, at.touched)
        self._launch(store_contact, at.points[:2], mask, at.touching, self._faces.weight, *matrices, *stored)
        right = (self._rows.free, at.force, at.volume, at.krylov)
        self._launch(gmres.begin_vectors, self._vectors, self.slots, *right)
        self._launch(gmres.begin, self.batch, self.slots, self.settings, at.krylov)

    def _iterate(self) -> None:
        """One Krylov iteration of all running solves."""
        at = self._at
        k, elements, reference = at.krylov, (len(self.pad.space.nodes), self.batch), self.pad.reference
        self._part = "preconditioner"
        reference.precondition(k)
        self.watch(self._part, "product with the inverse")
        self._part = "product"
        reference.turn_corrected(k)
        self.watch(self._part, "transpose")
        k.image.zero_()
        self.watch(self._part, "zeros")
        found = (at.stored, k.corrected, k.image)
        self._launch(self._product, elements, k.running, self._rows.single, *found, block=BLOCK)
        if self._lattice is not None:
            where = (at.folding, at.fields.iterate_u, self._lattice, self._rows.single.row)
            self._launch(fold_product, elements, k.running, *where, k.corrected, k.image)
        contact = (at.touched, self._rows.face_row, self._rows.face_shape, at.stored_contact)
        self._launch(self._contact_product, at.points[:2], k.running, *contact, k.corrected, k.image)
        reference.turn_image(k)
        self.watch(self._part, "transpose")
        self._part = "krylov"
        self._launch_blocks(self._arnoldi, self._block, k)

    def fill(self, assignment: np.ndarray, jobs: phases.Jobs, shapes: wp.array, grids: wp.array) -> None:
        """Begin trajectories. assignment: (B,) number of the job, -1: go on, -2: leave empty."""
        at = self._at
        at.assignment.assign(assignment.astype(np.int32))
        a, s = at.assignment, self.slots
        self._launch(refill, self.batch, a, jobs, shapes, self.settings, s, at.indenters)
        if grids.shape[1] > 1:
            self._launch(take_grids, (self.batch, grids.shape[1]), a, jobs, grids, at.indenters)
        self._launch(moves.clear, self._each, s, at.fields)
        self._launch(moves.forget, at.points, s, at.contact)

    def record_of(self, slot: int, count: int) -> FloatArray:
        """(count, ...) the states that a slot recorded."""
        at = self._at
        return np.asarray(at.records[slot].numpy()[:count])
