"""A batch of lanes on one device, and the cycle of kernels that takes all of them on.

A cycle takes the solutions of finished linear solves, tries their directions, lets every lane decide what is next,
begins linear solves, and does INNER_ITERATIONS Krylov iterations of all that are running. It is the same sequence of
launches whatever the phases of the lanes, so that on CUDA it is captured once as a graph; the host only asks which
lanes have ended.

On a CPU a trajectory's bits depend neither on its neighbours nor on its lane. On a GPU residuals and products are added
up by atomic operations in any order and cuBLAS chooses its algorithm by the size of the batch, so that the last bits of
a Newton iterate change from run to run even for the same batch; what converges meets Newton's tolerance, but may be
another equilibrium (docs/reports/batched_fem.md, Rounding).
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.batched import fields, reductions, transitions
from synth.simulate.batched import krylov as gmres
from synth.simulate.batched import lanes as phases
from synth.simulate.batched.arrays import BatchArrays, number_rows
from synth.simulate.batched.lanes import PATH_DERIVATIVE_STEP, copy_grids, fill_lanes, place_indenters
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.product import (
    BLOCK,
    barrier_product,
    bulk_product,
    contact_product,
    find_inverting,
    store_bulk,
    store_contact,
)
from synth.simulate.bulk import bulk_residual
from synth.simulate.contact import contact_residual, contact_stiffness
from synth.simulate.inversion_barrier import barrier_residual
from synth.simulate.multipliers import augment, update_contact_history
from synth.simulate.stiffness import viscous_force
from synth.simulate.tables import barrier_tables, bulk_tables, face_tables, nodal_weights, struct_of

INNER_ITERATIONS = 8
"""Krylov iterations of a cycle: a solve that ends within them waits for their end, on average half of them."""
PENALTY = 1.0
"""What kernels multiply `Indenters.sharpness` by, which here is a press's contact stiffness, E per mm."""
LINE_SEARCH_TRIALS = 2
"""Trials of the line search in a cycle; a lane that needs more goes on in the next."""


class BatchedSolver:
    """See the module's docstring.

    A trajectory records at most `records` states; `grid` are the counts of the largest distance grid of the indenters.
    `inner` are the Krylov iterations of a cycle.
    """

    def __init__(
        self,
        pad: Pad,
        presses: phases.Presses,
        batch: int,
        records: int,
        grid: tuple[int, int, int],
        settings: phases.Settings,
        inner: int,
    ) -> None:
        space, material, device = pad.space, pad.material, pad.device
        self.pad, self.batch, self.device, self.settings = pad, batch, device, settings
        rows = pad.preconditioner.rows
        self._bulk, self._faces = bulk_tables(space, material, pad.mixed, device), face_tables(space, device)
        self.inner, self._presses = inner, presses
        self._barrier = barrier_tables(space, material, device)
        self._rows = number_rows(space, pad.free, rows, self._bulk, device)
        surface = nodal_weights(space, self._faces.weight.numpy())
        self._surface = struct_of(reductions.SurfaceTables, device, **surface)
        self._product = bulk_product(space.nodes.shape[1], pad.mixed, space.element.stabilisation > 0, pad.yeoh)
        self._contact_product = contact_product(space.faces.shape[1])
        self._block = gmres.block_size(rows)
        self._arnoldi, self._solution = gmres.arnoldi(rows), gmres.solution(rows)
        self._arrays = BatchArrays(pad, batch, records, grid)
        self.lanes, self.krylov = self._arrays.lanes, self._arrays.krylov
        self._element_dim, self._face_dim = (batch, len(space.nodes)), self._arrays.points[:2]
        self._value_dim = (batch, len(space.points) + self._arrays.volume.shape[1])
        self.watch: Callable[[str, str], None] = lambda part, kernel: None
        """Called after each launch with the part of the cycle and the kernel's name, for profiles."""
        self._part = ""

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], *arguments: Any, block: int = 256) -> None:
        wp.launch(kernel, dim, inputs=list(arguments), device=self.device, block_dim=block)
        self.watch(self._part, kernel.key)

    def _launch_blocks(self, kernel: wp.Kernel, block: int, *arguments: Any) -> None:
        """One block of so many threads per lane."""
        wp.launch_tiled(kernel, dim=[self.batch], inputs=list(arguments), block_dim=block, device=self.device)
        self.watch(self._part, kernel.key)

    def _select(self, *wanted: int) -> None:
        self._launch(phases.select, self.batch, self.lanes, phases.bits(*wanted), self._arrays.mask)

    def cycle(self) -> None:
        self._take_solutions()
        for _ in range(LINE_SEARCH_TRIALS):
            self._evaluate()
        self._advance()
        self._evaluate()
        self._linearise()
        for _ in range(self.inner):
            self._iterate()

    def _take_solutions(self) -> None:
        a, self._part = self._arrays, "krylov"
        self._launch_blocks(self._solution, self._block, self.lanes, a.krylov, a.begun)
        self._launch(gmres.release, self.batch, a.krylov)
        where = (self._rows.node_row, self._rows.pressure_row, a.fields)
        self._launch(fields.apply_predictor, self._value_dim, a.begun, PATH_DERIVATIVE_STEP, a.step, *where)

    def _evaluate(self) -> None:
        """Evaluate the residuals of all lanes that wait for one, and what follows from them."""
        a, self._part = self._arrays, "residual"
        s, f, mask, elements = self.lanes, a.fields, a.mask, self._element_dim
        self._launch(place_indenters, self.batch, s, self._presses, a.indenters)
        self._select(phases.FRESH, phases.START, phases.SEARCH, phases.RESTORED, phases.PREDICTOR)
        where, residual = (self._rows.node_row, self._rows.pressure_row), (a.force, a.volume, a.jacobian)
        self._launch(fields.compute_trial, self._value_dim, s, mask, a.step, *where, f, a.force, a.viscous, a.volume)
        self._launch(bulk_residual, elements, f.trial_u, f.trial_p, mask, self._bulk, *residual)
        if self._barrier is not None:
            self._launch(barrier_residual, elements, f.trial_u, mask, self._barrier, a.force, a.jacobian)
        law, found = (self._faces, a.indenters, a.contact, PENALTY), (a.force, a.gap, a.tangential, a.traction)
        self._launch(contact_residual, self._face_dim, f.trial_u, mask, *law, *found)
        self._launch_blocks(reductions.residual_norms, reductions.BLOCK, mask, *residual, self._rows.node_row, f, s)
        self._launch(viscous_force, elements, mask, f.iterate_u, f.trial_u, s.viscosity, self._bulk, a.viscous)
        moved = (a.force, a.viscous, a.volume, *where, gmres.flat(a.krylov.basis))
        self._launch_blocks(reductions.relaxation_errors, reductions.BLOCK, mask, *moved, s)
        self._launch(transitions.evaluate_trial, self.batch, s)
        self._launch(fields.move_fields, self._value_dim, s, 0, f)

    def _advance(self) -> None:
        """Where a Newton solve ended: accept, correct, record, and choose the next step."""
        a, self._part = self._arrays, "stepping"
        s, f, multipliers = self.lanes, a.fields, (a.normal_before, a.tangent_before)
        self._launch(transitions.finish_solve, self.batch, s, self._presses, self.settings, a.indenters)
        self._launch(fields.move_fields, self._value_dim, s, phases.bits(phases.AT_RECORD, phases.CORRECTING), f)
        self._launch(fields.restore_multipliers, a.points, s, *multipliers, a.contact)
        self._sum(phases.AT_RECORD)
        self._launch(transitions.check_contact, self.batch, s, self._presses, a.sums)
        self._launch(fields.copy_memory, a.points, s.save, a.memory, a.saved)
        self._update_contact_history(s.anchor, 1)
        self._select(phases.CORRECTING)
        self._launch(reductions.clear_sums, a.sums.shape, a.mask, s, a.sums)
        self._launch(reductions.penetrations, self._face_dim, a.mask, a.gap, s)
        self._launch(transitions.choose_pass, self.batch, s, self._presses, self.settings, a.indenters)
        self._launch(fields.save_multipliers, a.points, s, a.contact, *multipliers)
        found = (a.gap, a.tangential, PENALTY)
        self._launch(augment, a.points, s.new_share, a.indenters, *found, a.contact)
        self._record()
        self._select(phases.ADVANCE, phases.FIRST)
        self._update_contact_history(a.mask, 0)
        self._launch(transitions.choose_target, self.batch, s, self._presses, self.settings)
        self._launch(fields.move_fields, self._value_dim, s, 0, f)

    def _sum(self, phase: int) -> None:
        a = self._arrays
        self._select(phase)
        self._launch(reductions.clear_sums, a.sums.shape, a.mask, self.lanes, a.sums)
        self._launch(reductions.penetrations, self._face_dim, a.mask, a.gap, self.lanes)
        found = (a.fields.iterate_u, self._faces, a.indenters, a.traction, a.tangential)
        self._launch(reductions.contact_forces, self._face_dim, a.mask, *found, a.sums)

    def _update_contact_history(self, mask: wp.array, new_only: int) -> None:
        a = self._arrays
        found = (self._faces, a.indenters, a.gap, a.tangential, PENALTY, new_only, a.contact)
        self._launch(update_contact_history, a.points, a.fields.state_u, mask, *found)

    def _record(self) -> None:
        a, s, u = self._arrays, self.lanes, self._arrays.fields.iterate_u
        self._sum(phases.RECORD)
        surface = len(self.pad.space.surface_nodes)
        self._launch(reductions.write_record, u.shape, a.mask, s, u, a.sums, surface, a.records)
        where = (self._faces, self._surface, a.traction, u.shape[1])
        self._launch(reductions.write_tractions, self._face_dim, a.mask, s, *where, a.records)
        self._select(phases.RECORD, phases.ROLLED_BACK)
        self._launch(fields.copy_memory, a.points, a.mask, a.saved, a.memory)
        self._launch(transitions.finish_record, self.batch, a.mask, s, self._presses, a.indenters)

    def _linearise(self) -> None:
        a, self._part = self._arrays, "tangent"
        s, f, mask, elements = self.lanes, a.fields, a.mask, self._element_dim[::-1]
        self._launch(place_indenters, self.batch, s, self._presses, a.indenters)
        self._select(phases.READY, phases.PREDICTOR_READY)
        self._launch(store_bulk, elements, mask, f.iterate_u, f.iterate_p, self._bulk, s.viscosity, a.stored)
        if self._barrier is not None:
            self._launch(find_inverting, elements, mask, f.iterate_u, self._barrier, a.inverting)
        law, matrices = (self._faces, a.indenters, a.contact, PENALTY), (a.symmetric, a.remainder)
        self._launch(contact_stiffness, self._face_dim, f.iterate_u, mask, *law, np.inf, a.touching, *matrices)
        stored = (a.stored_contact, a.touched)
        self._launch(store_contact, self._face_dim, mask, a.touching, self._faces.weight, *matrices, *stored)
        right = (self._rows.free, a.force, a.volume, a.krylov)
        self._launch(gmres.begin_vectors, a.krylov.step.shape, s, *right)
        self._launch(gmres.begin_solve, self.batch, s, self.settings, a.krylov)

    def _iterate(self) -> None:
        a, k, elements, preconditioner = self._arrays, self.krylov, self._element_dim[::-1], self.pad.preconditioner
        self._part = "preconditioner"
        preconditioner.apply(k)
        self.watch(self._part, "product with the inverse")
        self._part = "product"
        preconditioner.dense.transpose(gmres.flat(k.preconditioned), k.corrected)
        self.watch(self._part, "transpose")
        k.image.zero_()
        self.watch(self._part, "zeros")
        found = (a.stored, k.corrected, k.image)
        self._launch(self._product, elements, k.running, self._rows.single, *found, block=BLOCK)
        if self._barrier is not None:
            where = (a.inverting, a.fields.iterate_u, self._barrier, self._rows.single.row)
            self._launch(barrier_product, elements, k.running, *where, k.corrected, k.image)
        contact = (a.touched, self._rows.face_row, self._rows.face_shape, a.stored_contact)
        self._launch(self._contact_product, self._face_dim, k.running, *contact, k.corrected, k.image)
        preconditioner.dense.transpose(k.image, gmres.flat(k.product))
        self.watch(self._part, "transpose")
        self._part = "krylov"
        self._launch_blocks(self._arnoldi, self._block, k)

    def fill(self, assignment: np.ndarray) -> None:
        """Begin trajectories. assignment: (B,) number of the press, -1: go on, -2: leave empty."""
        a, s, presses = self._arrays, self.lanes, self._presses
        a.assignment.assign(assignment.astype(np.int32))
        self._launch(fill_lanes, self.batch, a.assignment, presses, self.settings, s, a.indenters)
        if presses.grids.shape[1] > 1:
            self._launch(copy_grids, (self.batch, presses.grids.shape[1]), a.assignment, presses, a.indenters)
        self._launch(fields.clear_fields, self._value_dim, s, a.fields)
        self._launch(fields.clear_contact, a.points, s, a.contact)

    def ended(self, lanes: np.ndarray) -> Iterator[tuple[int, FloatArray, tuple[int, float, float]]]:
        """Of each of these lanes its number, the states that it recorded, and how its trajectory ended.

        The end is a reason's code, the path length reached, and where the next step would have led, mm.
        """
        if not len(lanes):
            return
        s = self.lanes
        count, reason, at, target = (array.numpy() for array in (s.records, s.reason, s.at, s.target))
        for lane in map(int, lanes):
            # A copy: on a processor the lane's next press writes into the same memory.
            records = np.array(self._arrays.records[lane].numpy()[: count[lane]])
            yield lane, records, (int(reason[lane]), float(at[lane]), float(target[lane]))
