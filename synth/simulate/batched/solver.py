"""A batch of lanes on one device, and the cycle of kernels that takes all of them on.

A cycle does what the lanes are told (`synth.simulate.batched.lane_orders`), begins linear solves, does INNER_ITERATIONS
Krylov iterations of all that are running, and evaluates iterates and trials, those of directions that it has found
among them. A kernel is launched once for all lanes that want it, and not at all where none does. Then the host reads
what all lanes have seen, and their policies say what is next.

On a CPU a trajectory's bits depend neither on its neighbours nor on its lane. On a GPU residuals and products are added
up by atomic operations in any order and cuBLAS chooses its algorithm by the size of the batch, so that the last bits of
a Newton iterate change from run to run even for the same batch; what converges meets Newton's tolerance, but may be
another equilibrium (docs/reports/batched_fem.md, Rounding).
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.press.press import Press
from synth.simulate.batched import fields, lane_orders, reductions
from synth.simulate.batched import krylov as gmres
from synth.simulate.batched.arrays import BatchArrays, single_tables
from synth.simulate.batched.gpu import dense
from synth.simulate.batched.lane_orders import Order
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.presses import PressTable, padded
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
from synth.simulate.contact_friction import FAR, contact_residual, contact_stiffness
from synth.simulate.inversion_barrier import barrier_residual
from synth.simulate.multipliers import augment, update_contact_history
from synth.simulate.stiffness import viscous_force
from synth.simulate.tables import barrier_tables, bulk_tables, face_tables, nodal_weights, struct_of

THREADS = 256
"""Of a block, if a kernel does not ask for another number."""
INNER_ITERATIONS = 8
"""Krylov iterations of a cycle: a solve that ends within them waits for their end, on average half of them."""


class BatchedSolver:
    """See the module's docstring.

    A trajectory records at most `records` states; `grid` are the counts of the largest distance grid of the indenters.
    InputError for CUDA without cuBLAS.
    """

    def __init__(self, pad: Pad, batch: int, records: int, grid: tuple[int, int, int]) -> None:
        space, material, device = pad.space, pad.material, pad.device
        self.pad, self.batch, self.device = pad, batch, device
        rows = len(pad.inverse)
        self._bulk, self._faces = bulk_tables(space, material, pad.mixed, device), face_tables(space, device)
        self._table = PressTable(batch, device)
        self._presses = self._table.on_device()
        self._barrier = barrier_tables(space, material, device)
        self._single = single_tables(space, pad.free, rows, self._bulk, device)
        surface = nodal_weights(space, self._faces.weight.numpy())
        self._surface = struct_of(reductions.SurfaceTables, device, **surface)
        self._product = bulk_product(space.nodes.shape[1], pad.mixed, space.element.stabilisation > 0, pad.yeoh)
        self._contact_product = contact_product(space.faces.shape[1])
        self._block = gmres.block_size(rows)
        self._arnoldi, self._solution = gmres.arnoldi(rows), gmres.solution(rows)
        self._arrays = BatchArrays(pad, batch, records, grid)
        self.krylov = self._arrays.krylov
        self._element_dim, self._face_dim = (batch, len(space.nodes)), self._arrays.points[:2]
        self._value_dim = self._arrays.residual.shape
        self._is_warm, self._graph = False, None
        cuda = wp.get_device(device).is_cuda
        self._seen = wp.empty_like(self._arrays.seen, device="cpu", pinned=cuda)
        self._ended = wp.Event(device) if cuda else None
        self._stream, self._aside = (wp.Stream(device) if cuda else None for _ in range(2))
        self._dense = pad.products or dense(device)
        if cuda:
            self._load_own_kernels()
            wp.synchronize_device(device)

    def _load_own_kernels(self) -> None:
        """Load the kernels made for this pad; on a new machine they are compiled, all at once."""
        flat = ((self._product, BLOCK), (self._contact_product, THREADS))
        tiled = ((kernel, self._block) for kernel in (self._arnoldi, self._solution))
        with ThreadPoolExecutor() as threads:
            load = partial(wp.load_module, device=self.device)
            for each in [threads.submit(load, kernel.module, block_dim=block) for kernel, block in (*flat, *tiled)]:
                each.result()

    def _scope(self) -> wp.ScopedStream:
        """Work on the solver's own stream, so that a GPU may do it beside another solver's."""
        return wp.ScopedStream(self._stream, sync_enter=False)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], *arguments: Any, block: int = THREADS) -> None:
        wp.launch(kernel, dim, inputs=list(arguments), device=self.device, block_dim=block)

    def _launch_blocks(self, kernel: wp.Kernel, block: int, *arguments: Any) -> None:
        """One block of so many threads per lane."""
        wp.launch_tiled(kernel, dim=[self.batch], inputs=list(arguments), block_dim=block, device=self.device)

    def begin_cycle(self, orders: np.ndarray, numbers: FloatArray) -> None:
        """Do what all lanes are told; on CUDA queue it.

        orders: (B,) sets of `lane_orders.Order`; numbers: (B, k) by the columns of `lane_orders.Number`.
        """
        a = self._arrays
        with self._scope():
            a.orders.assign(orders)
            a.numbers.assign(numbers)
            self._wanted = int(np.bitwise_or.reduce(orders))
            self._end_solves()
            self._begin_steps()
            self._launch(lane_orders.place_indenters, self.batch, a.orders, a.numbers, self._presses, a.indenters)
            self._solve_and_evaluate()
            wp.copy(self._seen, a.seen)
            if self._stream is not None:
                self._stream.record_event(self._ended)

    def seen(self) -> FloatArray:
        """Wait for the end of the cycle; (B, k) what the lanes have seen, by the columns of `lane_orders.Seen`."""
        if self._ended is not None:
            wp.synchronize_event(self._ended)
        return np.asarray(self._seen.numpy())

    def _solve_and_evaluate(self) -> None:
        """What every cycle does; on CUDA a graph that is captured the second time, when all kernels are loaded."""
        device = wp.get_device(self.device)
        if not device.is_cuda or not self._is_warm:
            self._launch_all()
            self._is_warm = True
            return
        if self._graph is None:
            # Relaxed: the garbage collector may free a renderer's memory in this thread meanwhile.
            mode = wp.CaptureMode.RELAXED
            with wp.ScopedCapture(device=device, force_module_load=False, capture_mode=mode) as capture:
                self._launch_all()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _launch_all(self) -> None:
        a = self._arrays
        self._launch(lane_orders.select, self.batch, a.orders, Order.SOLVE, a.mask)
        self._linearise()
        for _ in range(INNER_ITERATIONS):
            self._iterate()
        self._launch_blocks(self._solution, self._block, a.krylov, a.seen)
        self._launch(gmres.release, self.batch, a.krylov, a.orders, a.numbers, a.share, a.mask)
        self._evaluate()

    def _told(self, *orders: int) -> bool:
        """Whether any lane is told any of these; which ones is then the mask."""
        wanted = sum(orders)
        if not self._wanted & wanted:
            return False
        self._launch(lane_orders.select, self.batch, self._arrays.orders, wanted, self._arrays.mask)
        return True

    def _end_solves(self) -> None:
        """Where a Newton solve ended: the iterate, snapshots of it, multipliers, and what is recorded."""
        a = self._arrays
        if self._told(Order.TAKE, Order.RESTORE_PASS, Order.REPEAT, Order.KEEP_STEP, Order.KEEP_PASS):
            self._launch(fields.to_solution, self._value_dim, a.mask, a.orders, a.fields)
        if self._told(Order.RESTORE_PASS):
            self._launch(fields.copy_memory, a.points, a.mask, a.before_pass, a.memory)
        if self._told(Order.KEEP_STEP):
            self._launch(fields.copy_memory, a.points, a.mask, a.memory, a.after_step)
        if self._told(Order.ANCHOR):
            self._update_contact_history(a.iterate.u, 1)
        if self._told(Order.KEEP_PASS):
            self._launch(fields.copy_memory, a.points, a.mask, a.memory, a.before_pass)
        if self._told(Order.FORCE, Order.RECORD):
            a.sums.zero_()
            found = (a.iterate.u, self._faces, a.indenters, a.traction, a.tangential)
            self._launch(reductions.contact_forces, self._face_dim, a.mask, *found, a.sums)
        if self._told(Order.RECORD):
            written, size = (a.fields.iterate, a.nodes, a.sums, a.records), (self.batch, a.records.shape[2])
            self._launch(reductions.write_record, size, a.mask, a.numbers, *written)
            where = (self._faces, self._surface, a.traction, a.nodes)
            self._launch(reductions.write_tractions, self._face_dim, a.mask, a.numbers, *where, a.records)

    def _begin_steps(self) -> None:
        """Steps that are accepted, passes and steps that begin."""
        a = self._arrays
        if self._told(Order.RESTORE_STEP):
            self._launch(fields.copy_memory, a.points, a.mask, a.after_step, a.memory)
        wp.copy(a.indenters.stiffness, a.stiffness)
        if self._told(Order.RESTORE_STEP, Order.ACCEPT, Order.BEGIN, Order.PREDICT):
            step = (a.step, self._single.row, a.fields)
            self._launch(fields.to_start, self._value_dim, a.mask, a.orders, a.numbers, *step)
        if self._told(Order.ACCEPT):
            self._update_contact_history(a.state.u, 0)
        if self._told(Order.AUGMENT):
            found = (a.indenters, a.gap, a.tangential, a.contact)
            self._launch(augment, a.points, a.mask, a.asked_share, *found)

    def _update_contact_history(self, u: wp.array, new_only: int) -> None:
        a = self._arrays
        found = (self._faces, a.indenters, a.gap, a.tangential, new_only, a.contact)
        self._launch(update_contact_history, a.points, u, a.mask, *found)

    def _evaluate(self) -> None:
        """Evaluate the residuals of iterates and trials."""
        a = self._arrays
        mask, elements, row, u = a.mask, self._element_dim, self._single.row, a.trial.u
        trial = (a.share, a.step, row, a.fields, a.residual, a.viscous)
        self._launch(fields.compute_trial, self._value_dim, mask, *trial)
        self._launch(bulk_residual, elements, *a.trial, mask, self._bulk, *a.forces, a.jacobian)
        if self._barrier is not None:
            self._launch(barrier_residual, elements, u, mask, self._barrier, a.forces.u, a.jacobian)
        law, contact = (self._faces, a.indenters, a.contact), (a.forces.u, a.gap, a.tangential, a.traction)
        self._launch(contact_residual, self._face_dim, u, mask, *law, *contact)
        self._launch(viscous_force, elements, mask, a.iterate.u, u, a.viscosity, self._bulk, a.viscous_forces.u)
        found = (a.residual, a.viscous, a.nodes, a.jacobian, a.gaps, row, a.fields)
        solve = (gmres.flat(a.krylov.basis), a.share, a.numbers)
        self._launch_blocks(reductions.evaluations, reductions.BLOCK, mask, *found, *solve, a.seen)

    def _linearise(self) -> None:
        a = self._arrays
        u, mask, elements = a.iterate.u, a.mask, self._element_dim[::-1]
        self._launch(store_bulk, elements, mask, *a.iterate, self._bulk, a.viscosity, a.stored)
        if self._barrier is not None:
            self._launch(find_inverting, elements, mask, u, self._barrier, a.inverting)
        law, matrices = (self._faces, a.indenters, a.contact), (a.symmetric, a.remainder)
        self._launch(contact_stiffness, self._face_dim, u, mask, *law, a.turn, a.touching, *matrices)
        stored = (a.touching, self._faces.weight, *matrices, a.stored_contact)
        self._launch(store_contact, self._face_dim, mask, *stored)
        right = (self._single.unknown, a.residual, a.krylov)
        self._launch(gmres.begin_solves, a.krylov.step.shape, mask, a.numbers, *right)

    def _iterate(self) -> None:
        self._precondition()
        self._multiply()
        self._launch_blocks(self._arnoldi, self._block, self.krylov)

    def _precondition(self) -> None:
        k = self.krylov
        self._dense.product(self.pad.inverse, gmres.flat(k.current), gmres.flat(k.preconditioned), k.running)

    def _multiply(self) -> None:
        """The tangent times the preconditioned vectors."""
        a, k, elements, transpose = self._arrays, self.krylov, self._element_dim[::-1], self._dense.transpose
        transpose(gmres.flat(k.preconditioned), k.corrected)
        k.image.zero_()
        found = (a.stored, k.corrected, k.image)
        self._launch(self._product, elements, k.running, self._single, *found, block=BLOCK)
        if self._barrier is not None:
            where = (a.inverting, a.iterate.u, self._barrier, self._single)
            self._launch(barrier_product, elements, k.running, *where, k.corrected, k.image)
        contact = (a.touching, self._single, a.stored_contact)
        self._launch(self._contact_product, self._face_dim, k.running, *contact, k.corrected, k.image)
        transpose(k.image, gmres.flat(k.product))

    def fill(self, presses: Mapping[int, Press]) -> None:
        """Begin presses, by lane."""
        a, indenters, grids = self._arrays, self._arrays.indenters, self._arrays.indenters.coefficients
        untouched = (a.fields.state, a.fields.previous, a.contact.normal, a.contact.tangent, a.contact.anchored)
        with self._scope():
            for s, press in presses.items():
                self._table.put(s, press)
                for values in untouched:
                    values[s].zero_()
                a.contact.gap[s].fill_(FAR)
                if grids.size > self.batch:
                    grids[s].assign(padded(press.path.body.coefficients, grids.shape[1:]))
            self._presses = self._table.on_device()
            indenters.kind.assign(self._table.kind)
            indenters.shape.assign(self._table.shape)

    def recorded(self, lane: int, count: int) -> FloatArray:
        """The first states that a lane has recorded, a copy: its next press writes into the same memory.

        It does not wait for the cycle of another solver.
        """
        records = self._arrays.records[lane][: max(count, 1)]
        found = wp.empty_like(records, device="cpu")
        wp.copy(found, records, stream=self._aside)
        if self._aside is not None:
            wp.synchronize_stream(self._aside)
        return np.asarray(found.numpy()[:count])
