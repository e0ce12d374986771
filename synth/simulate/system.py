"""The discrete system of one pad for a batch of samples: unknowns, residual, tangent, Newton direction.

Unknowns of a sample: 3 displacements per node, then the pressures (none for displacement-only foams); held ones keep
their value. Everything is in units of the gel's Young's modulus, so stiffness never enters the conditioning: a pad
a thousand times stiffer deforms identically.
"""

from typing import Any

import numpy as np
import warp as wp

from synth.arrays import BoolArray, FloatArray
from synth.simulate.bulk import bulk_residual
from synth.simulate.contact import ContactState, Indenters, contact_residual, contact_stiffness, contact_tangent
from synth.simulate.inversion_barrier import barrier_residual, barrier_tangent
from synth.simulate.linear import Directions
from synth.simulate.material import Material
from synth.simulate.multipliers import augment, settle
from synth.simulate.pattern import pattern_of
from synth.simulate.space import Space
from synth.simulate.stiffness import bulk_tangent, linearise, pressure_tangent, viscous_force
from synth.simulate.tables import barrier_tables, bulk_tables, face_tables, laplace_table, warp_array
from synth.simulate.unknowns import Balance, Tangent, Unknowns
from synth.surface import broken_linear_face


class System:
    """Kernels, arrays and sparse pattern of one pad; see the module's docstring.

    Args:
        space: the pad's finite-element space.
        material: of its elements.
        batch: number of samples.
        penalty: contact stiffness, E per mm.
        load: (n, 3) dead nodal forces in E mm², or None.
        device: Warp device.
        single: factorise tangents in single precision.
        keep: of `synth.simulate.linear.Directions`.
    """

    def __init__(
        self,
        space: Space,
        material: Material,
        batch: int = 1,
        penalty: float = 50.0,
        load: FloatArray | None = None,
        device: str = "cpu",
        single: bool = True,
        keep: bool = True,
    ) -> None:
        self.space, self.batch, self.penalty, self.device, self.load = space, batch, penalty, device, load
        self.mixed = material.mixed and space.element.has_pressure
        self._pattern = pattern_of(space, self.mixed)
        self._directions = [Directions(self._pattern.factor(single, s), keep) for s in range(batch)]
        self._bulk = bulk_tables(space, material, self.mixed, device)
        self._laplace = laplace_table(space, material, self._pattern.element_pairs, device)
        self._faces = face_tables(space, device)
        self._lattice = barrier_tables(space, material, device)
        self._pairs = warp_array(self._pattern.element_pairs, wp.vec2i, device)
        self._face_pairs = warp_array(self._pattern.face_pairs, wp.vec2i, device)
        slots = (self._pattern.block_slot, self._pattern.coupling_slot, self._pattern.pressure_slot)
        self._block_slot, self._coupling_slot, self._pressure_slot = (warp_array(s, wp.int32, device) for s in slots)
        self._face_slot = warp_array(self._pattern.face_slot, wp.int32, device)
        self._allocate()

    @property
    def free(self) -> np.ndarray:
        """(k,) numbers of the unknowns that are not held."""
        return self._pattern.free

    def matrix(self, values: FloatArray) -> Any:
        """The upper triangle of one sample's symmetric part as SciPy CSR."""
        import scipy.sparse as sp

        size = len(self.free)
        return sp.csr_matrix((values, self._pattern.indices, self._pattern.indptr), shape=(size, size))

    def _allocate(self) -> None:
        d, element, count = self.device, self.space.element, len(self.space.nodes)
        points = (self.batch, len(self.space.faces), len(element.face_weights))
        self.contact = ContactState()
        self.contact.normal = wp.zeros(points, dtype=wp.float64, device=d)
        self.contact.tangent = wp.zeros(points, dtype=wp.vec3d, device=d)
        self.contact.anchor = wp.zeros(points, dtype=wp.vec3d, device=d)
        self.contact.anchored = wp.zeros(points, dtype=wp.int32, device=d)
        self.contact.place = wp.zeros(points, dtype=wp.vec3d, device=d)
        self.contact.gap = wp.full(points, 1e30, dtype=wp.float64, device=d)
        self.gap = wp.full(points, 1e30, dtype=wp.float64, device=d)
        self.tangential = wp.zeros(points, dtype=wp.vec3d, device=d)
        self.traction = wp.zeros(points, dtype=wp.vec3d, device=d)
        self._stiffness = wp.zeros(points, dtype=wp.mat33d, device=d)
        self._remainder = wp.zeros(points, dtype=wp.mat33d, device=d)
        self._touching = wp.zeros(points[:2], dtype=wp.int32, device=d)
        at_points = (self.batch, count, len(element.weights))
        self._factor = wp.zeros(at_points, dtype=wp.vec4d, device=d)
        self._held = wp.zeros(at_points, dtype=wp.vec4d, device=d)
        self._pushed, self._drift = (
            wp.zeros((*at_points, self.space.nodes.shape[1]), dtype=wp.vec3d, device=d) for _ in range(2)
        )
        self._values = wp.zeros((self.batch, self._pattern.size + 1), dtype=wp.float64, device=d)

    def zero(self) -> Unknowns:
        """The undeformed batch."""
        pressures = self.space.pressures if self.mixed else 0
        return Unknowns(np.zeros((self.batch, len(self.space.points), 3)), np.zeros((self.batch, pressures)))

    def _device_state(self, state: Unknowns, active: np.ndarray) -> tuple[wp.array, wp.array, wp.array]:
        return (
            warp_array(state.u, wp.vec3d, self.device),
            warp_array(state.p, wp.float64, self.device),
            warp_array(active.astype(np.int32), wp.int32, self.device),
        )

    def balance(self, state: Unknowns, indenters: Indenters, active: np.ndarray) -> Balance:
        """Residual of the active samples (others: zeros)."""
        u, p, mask = self._device_state(state, active)
        count = len(self.space.nodes)
        force = wp.zeros((self.batch, len(self.space.points)), dtype=wp.vec3d, device=self.device)
        volume = wp.zeros(state.p.shape, dtype=wp.float64, device=self.device)
        jacobian = wp.full((self.batch, count), 1.0, dtype=wp.float64, device=self.device)
        wp.launch(
            bulk_residual,
            (self.batch, count),
            inputs=[u, p, mask, self._bulk],
            outputs=[force, volume, jacobian],
            device=self.device,
        )
        if self._lattice is not None:
            inputs, outputs = [u, mask, self._lattice], [force, jacobian]
            wp.launch(barrier_residual, (self.batch, count), inputs=inputs, outputs=outputs, device=self.device)
        wp.launch(
            contact_residual,
            self.gap.shape[:2],
            inputs=[u, mask, self._faces, indenters, self.contact, self.penalty],
            outputs=[force, self.gap, self.tangential, self.traction],
            device=self.device,
        )
        reaction = force.numpy()
        if self.load is not None:
            reaction = reaction - self.load * active[:, None, None]
        full = np.concatenate([reaction.reshape(self.batch, -1), volume.numpy()], axis=1)
        # Indexing columns leaves them strided, and sums over a row would then depend on the size of the batch.
        return Balance(np.ascontiguousarray(full[:, self.free]), reaction, jacobian.numpy().min(axis=1))

    def tangent(
        self, state: Unknowns, indenters: Indenters, active: np.ndarray, viscosity: FloatArray | None = None
    ) -> Tangent:
        """Derivative of the free residual of the active samples, plus viscosity (B,) times `viscous_force`'s."""
        thick = np.zeros(self.batch) if viscosity is None else viscosity
        u, p, mask = self._device_state(state, active)
        elements, d = (self.batch, len(self.space.nodes)), self.device
        linearised = [self._factor, self._held, self._pushed, self._drift]
        self._values.zero_()
        wp.launch(linearise, elements, inputs=[u, p, mask, self._bulk], outputs=linearised, device=d)
        wp.launch(
            bulk_tangent,
            elements,
            inputs=[
                mask,
                self._bulk,
                self._laplace,
                warp_array(thick, wp.float64, d),
                self._factor,
                self._pushed,
                self._drift,
                self._block_slot,
            ],
            outputs=[self._values],
            device=d,
        )
        if self._lattice is not None:
            inputs = [u, mask, self._lattice, self._pairs, self._block_slot]
            wp.launch(barrier_tangent, elements, inputs=inputs, outputs=[self._values], device=d)
        if self.mixed:
            wp.launch(
                pressure_tangent,
                elements,
                inputs=[mask, self._bulk, self._held, self._pushed, self._coupling_slot, self._pressure_slot],
                outputs=[self._values],
                device=d,
            )
        wp.launch(
            contact_stiffness,
            self.gap.shape[:2],
            inputs=[u, mask, self._faces, indenters, self.contact, self.penalty],
            outputs=[self._touching, self._stiffness, self._remainder],
            device=d,
        )
        wp.launch(
            contact_tangent,
            (*self.gap.shape[:2], len(self._pattern.face_pairs)),
            inputs=[self._faces, self._face_pairs, self._touching, self._stiffness, self._face_slot],
            outputs=[self._values],
            device=d,
        )
        values = self._values.numpy()[:, :-1]
        return Tangent(values, tuple(self._unsymmetric(s) for s in range(self.batch)))

    def viscous_force(self, before: Unknowns, after: Unknowns, active: np.ndarray, viscosity: FloatArray) -> FloatArray:
        """(B, k) force on the free unknowns against a step with viscosities (B,), see `synth.simulate.relaxation`."""
        force = wp.zeros((self.batch, len(self.space.points)), dtype=wp.vec3d, device=self.device)
        (old, _, mask), (new, _, _) = self._device_state(before, active), self._device_state(after, active)
        inputs = [mask, old, new, warp_array(viscosity, wp.float64, self.device), self._bulk]
        elements = (self.batch, len(self.space.nodes))
        wp.launch(viscous_force, elements, inputs=inputs, outputs=[force], device=self.device)
        full = np.concatenate([force.numpy().reshape(self.batch, -1), np.zeros_like(before.p)], axis=1)
        return np.ascontiguousarray(full[:, self.free])

    def _unsymmetric(self, sample: int) -> Any:
        """The remainder of one sample's friction as a sparse matrix, or None where there is none."""
        import scipy.sparse as sp

        rubbing = np.flatnonzero(self._touching.numpy()[sample] == 2)
        if len(rubbing) == 0:
            return None
        shape, weight = self.space.element.face_shape, self._faces.weight.numpy()[rubbing]
        blocks = weight[:, :, None, None] * self._remainder.numpy()[sample, rubbing]
        pairs = np.einsum("qa,qb->qab", shape, shape).reshape(len(shape), -1)
        count, nodes = len(rubbing), shape.shape[1]
        dense = np.matmul(pairs.T, blocks.reshape(count, len(shape), 9)).reshape(count, nodes, nodes, 3, 3)
        dense = dense.transpose(0, 1, 3, 2, 4).reshape(count, 3 * nodes, 3 * nodes)
        number = self._pattern.face_unknowns[rubbing]
        row, column = np.broadcast_arrays(number[:, :, None], number[:, None, :])
        kept = (row >= 0) & (column >= 0)
        size = len(self.free)
        return sp.csr_matrix((dense[kept], (row[kept], column[kept])), shape=(size, size))

    def begin(self, samples: BoolArray | None = None) -> None:
        """Forget the factors of these samples' earlier tangents (None: of all), so that what follows depends on the
        state alone.
        """
        for number, directions in enumerate(self._directions):
            if samples is None or samples[number]:
                directions.begin()

    def newton_step(
        self, tangent: Tangent, residual: FloatArray, active: BoolArray, rough: BoolArray | None = None
    ) -> Unknowns:
        """-K^-1 r of each active sample; NaN where the matrix is singular.

        rough: (B,) samples for which a rough direction is enough (`synth.simulate.linear.Directions`); default none.
        """
        step = self.zero()
        moves = step.u[0].size
        full = np.zeros(moves + step.p.shape[1])
        for s in map(int, np.flatnonzero(active)):
            matrix = self.matrix(tangent.values[s])
            enough = rough is not None and bool(rough[s])
            full[self.free] = -self._directions[s].solve(matrix, tangent.remainder[s], residual[s], enough)
            step.u[s], step.p[s] = full[:moves].reshape(-1, 3), full[moves:]
        return step

    def augment(self, indenters: Indenters, share: FloatArray) -> None:
        """Augmented-Lagrangian update at the last balance: of each sample its share (B,), 1 for all of it."""
        wp.launch(
            augment,
            self.gap.shape,
            inputs=[warp_array(share, wp.float64, self.device), indenters, self.gap, self.tangential, self.penalty],
            outputs=[self.contact],
            device=self.device,
        )

    def anchor(self, state: Unknowns, indenters: Indenters, active: np.ndarray) -> None:
        """Anchor the points of the active samples that touch for the first time."""
        self._launch_contact(settle, state, indenters, active, 1)

    def settle(self, state: Unknowns, indenters: Indenters, active: np.ndarray) -> None:
        """Accept the step of the active samples: friction's anchors follow."""
        self._launch_contact(settle, state, indenters, active, 0)

    def _launch_contact(
        self, kernel: wp.Kernel, state: Unknowns, indenters: Indenters, active: np.ndarray, *options: int
    ) -> None:
        u, _, mask = self._device_state(state, active)
        wp.launch(
            kernel,
            self.gap.shape,
            inputs=[u, mask, self._faces, indenters, self.gap, self.tangential, self.penalty, *options, self.contact],
            device=self.device,
        )

    def deepest(self) -> FloatArray:
        """(B,) largest penetration at the last balance, mm."""
        return np.maximum(0.0, -self.gap.numpy().min(axis=(1, 2)))

    def slip_ratio(self, indenters: Indenters) -> FloatArray:
        """(B,) area of the points that slip at the last balance over that of all touching points; 0 without any.

        Without friction everything that touches slips.
        """
        weight, traction = self._faces.weight.numpy(), self.traction.numpy()
        along = np.linalg.norm(self.tangential.numpy(), axis=3)
        pressure = np.sqrt(np.maximum((traction**2).sum(axis=3) - along**2, 0.0))
        limit = indenters.friction.numpy()[:, None, None] * pressure
        touching = pressure > 0
        slipping = touching & (along >= (1 - 1e-6) * limit)
        area = (weight * touching).sum(axis=(1, 2))
        return np.asarray((weight * slipping).sum(axis=(1, 2)) / np.where(area > 0, area, 1.0))

    def forces(self, state: Unknowns) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the indenter on the gel at the last balance, in units of E.

        Returns:
            (B, 3) force in E mm²; (B, 3) moment about the frame's origin in E mm³; (B, s, 3) traction at the nodes of
            the coated surface (E, per undeformed area), the mean of the quadrature points near a node, weighted by the
            node's piecewise linear function.
        """
        shape, weight = self.space.element.face_shape, self._faces.weight.numpy()
        traction = self.traction.numpy()
        position = (self.space.points + state.u)[:, self.space.faces]
        arm = np.einsum("qa,sfac->sfqc", shape, position)
        force = np.einsum("fq,sfqc->sc", weight, traction)
        moment = np.einsum("fq,sfqc->sc", weight, np.cross(arm, traction))
        return force, moment, self._nodal(weight, traction)

    def _nodal(self, weight: FloatArray, traction: FloatArray) -> FloatArray:
        """Traction at the surface's nodes; the mean with the shape functions themselves would weigh P2 corners by 0."""
        element = self.space.element
        hat = element.face_shape if element.order == 1 else broken_linear_face(element.face_barycentric)
        coated = self.space.coated  # the sides would water down the rim
        faces, weight, traction = self.space.faces[coated], weight[coated], traction[:, coated]
        nodal = np.zeros((self.batch, len(self.space.points), 3))
        area = np.zeros(len(self.space.points))
        np.add.at(area, faces, np.einsum("fq,qa->fa", weight, hat))
        shares = np.einsum("fq,qa,sfqc->sfac", weight, hat, traction)
        for s in range(self.batch):
            np.add.at(nodal[s], faces, shares[s])
        wanted = self.space.surface_nodes
        return np.asarray(nodal[:, wanted] / area[wanted, None])
