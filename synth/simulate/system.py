"""The discrete system of one pad for a batch of samples: unknowns, sparse pattern, residual and tangent.

Unknowns of a sample: 3 displacements per node, then one pressure per node (none for displacement-only foams); bonded
displacements are held at zero. Everything is scaled by the pad's Young's modulus, so stiffness never enters the
conditioning: a pad a thousand times stiffer deforms identically.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.simulate.bulk import bulk_residual, bulk_tangent
from synth.simulate.contact import (
    ContactState,
    Faces,
    Indenters,
    augment,
    contact_residual,
    contact_tangent,
    settle,
)
from synth.simulate.element import Element, barycentric_gradients
from synth.simulate.linear import DirectSolver, direct_solver

DISPLACEMENT_ONLY_BELOW = 0.3
"""Poisson ratio under which no pressure field is needed; at 0 the mixed form would not even be defined."""


def warp_array(values: np.ndarray, dtype: type, device: str) -> wp.array:
    """A Warp array of contiguous values; vectors and matrices take the trailing axes."""
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)


@dataclass(frozen=True)
class Unknowns:
    """State of a batch: displacement (B, n, 3) mm and pressure (B, n) in units of E."""

    u: FloatArray
    p: FloatArray

    def plus(self, step: "Unknowns", scale: FloatArray) -> "Unknowns":
        """This plus scale (B,) times step."""
        return Unknowns(self.u + scale[:, None, None] * step.u, self.p + scale[:, None] * step.p)

    def where(self, mask: np.ndarray, other: "Unknowns") -> "Unknowns":
        """This where mask (B,) is true, else other."""
        return Unknowns(np.where(mask[:, None, None], self.u, other.u), np.where(mask[:, None], self.p, other.p))


@dataclass(frozen=True)
class Balance:
    """Residual of a batch.

    Attributes:
        free: (B, k) residual of the unknowns that are not held.
        reaction: (B, n, 3) all nodal forces including those on held nodes, in units of E mm².
        smallest_jacobian: (B,) smallest det F; the residual means nothing where it is <= 0.
    """

    free: FloatArray
    reaction: FloatArray
    smallest_jacobian: FloatArray


class System:
    """Kernels, arrays and sparse pattern of one pad; see the module's docstring.

    Args:
        mesh: the pad.
        poisson_ratio: below 0.5.
        batch: number of samples.
        symmetric: no friction anywhere: half the matrix is kept and factorised.
        penalty: contact stiffness, E per mm.
        element: tables.
        device: Warp device.
    """

    def __init__(
        self,
        mesh: PadMesh,
        poisson_ratio: float,
        batch: int,
        symmetric: bool,
        penalty: float,
        element: Element,
        device: str = "cpu",
    ) -> None:
        self.mesh, self.batch, self.symmetric, self.penalty, self.device = mesh, batch, symmetric, penalty, device
        self.nodes, self.mixed = len(mesh.points), poisson_ratio >= DISPLACEMENT_ONLY_BELOW
        self._bulk = self._bulk_arrays(mesh, poisson_ratio, element)
        self._faces, self._face_nodes = self._face_arrays(mesh, element)
        self._pattern()
        shape = (batch, len(mesh.contact_faces.faces), len(element.face_weights))
        self.contact = ContactState()
        self.contact.normal = wp.zeros(shape, dtype=wp.float64, device=device)
        self.contact.tangent = wp.zeros(shape, dtype=wp.vec3d, device=device)
        self.contact.anchor = wp.zeros(shape, dtype=wp.vec3d, device=device)
        self.contact.anchored = wp.zeros(shape, dtype=wp.int32, device=device)
        self.gap = wp.zeros(shape, dtype=wp.float64, device=device)
        self.tangential = wp.zeros(shape, dtype=wp.vec3d, device=device)
        self.traction = wp.zeros(shape, dtype=wp.vec3d, device=device)
        self._solver: DirectSolver | None = None

    def _bulk_arrays(self, mesh: PadMesh, poisson_ratio: float, element: Element) -> list[wp.array]:
        barycentric = barycentric_gradients(mesh.points, mesh.tets)
        gradient = np.einsum("qak,ekd->eqad", element.derivative, barycentric)
        weight = mesh.volumes[:, None] * element.weights
        mu = 1 / (2 * (1 + poisson_ratio))
        lame = poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))
        mass = (np.ones((4, 4)) + np.eye(4)) / 20
        matrix = -element.stabilisation / mu * (mass - 1 / 16)
        if self.mixed:
            matrix = matrix - mass / lame
        pressure_matrix = mesh.volumes[:, None, None] * matrix
        count, d = len(mesh.tets), self.device
        return [
            warp_array(mesh.tets, wp.int32, d),
            warp_array(mesh.tets, wp.int32, d),
            warp_array(gradient, wp.vec3d, d),
            warp_array(weight, wp.float64, d),
            warp_array(element.barycentric, wp.float64, d),
            warp_array(pressure_matrix, wp.float64, d),
            warp_array(np.full(count, mu), wp.float64, d),
            warp_array(np.full(count, -1.0 if self.mixed else lame), wp.float64, d),
        ]

    def _face_arrays(self, mesh: PadMesh, element: Element) -> tuple[Faces, np.ndarray]:
        nodes = mesh.contact_nodes[mesh.contact_faces.faces].astype(np.int32)
        a, b, c = (mesh.points[nodes[:, i]] for i in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        faces = Faces()
        faces.nodes = warp_array(nodes, wp.int32, self.device)
        faces.shape = warp_array(element.face_shape, wp.float64, self.device)
        faces.weight = warp_array(area[:, None] * element.face_weights, wp.float64, self.device)
        faces.points = warp_array(mesh.points, wp.vec3d, self.device)
        return faces, nodes

    def _pattern(self) -> None:
        """CSR pattern of the free unknowns and, per element and face, where its entries go."""
        import scipy.sparse as sp

        n, tets = self.nodes, self.mesh.tets.astype(np.int64)
        total = 3 * n + (n if self.mixed else 0)
        held = np.zeros(total, dtype=bool)
        held[: 3 * n] = np.repeat(self.mesh.bonded, 3)
        self.free = np.flatnonzero(~held)
        number = np.full(total, -1, dtype=np.int64)
        number[self.free] = np.arange(len(self.free))

        def unknowns(nodes: np.ndarray, pressures: bool) -> np.ndarray:
            moves = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
            return number[np.concatenate([moves, 3 * n + nodes], axis=1) if pressures else moves]

        def keys(local: np.ndarray) -> np.ndarray:
            row, column = local[:, :, None], local[:, None, :]
            keep = (row >= 0) & (column >= 0)
            if self.symmetric:
                keep = keep & (row <= column)
            return np.where(keep, row * len(self.free) + column, -1)

        local = unknowns(tets, self.mixed)
        element, place = np.nonzero(local >= 0)
        incidence = sp.csr_matrix(
            (np.ones(len(element), dtype=np.int32), (element, local[element, place])), shape=(len(tets), len(self.free))
        )
        coupled = (incidence.T @ incidence).tocsr()
        if self.symmetric:
            coupled = sp.triu(coupled, format="csr")
        coupled.sort_indices()
        self.indptr, self.indices = coupled.indptr.astype(np.int32), coupled.indices.astype(np.int32)
        entries = np.repeat(np.arange(len(self.free)), np.diff(self.indptr)) * len(self.free) + self.indices
        element_keys = keys(local)

        def slots(wanted: np.ndarray) -> wp.array:
            place = np.where(wanted >= 0, np.searchsorted(entries, wanted), len(entries))
            return warp_array(place.astype(np.int32), wp.int32, self.device)

        self._element_slot = slots(element_keys)
        self._face_slot = slots(keys(unknowns(self._face_nodes.astype(np.int64), False)))
        self._values = wp.zeros((self.batch, len(entries) + 1), dtype=wp.float64, device=self.device)

    def zero(self) -> Unknowns:
        """The undeformed batch."""
        return Unknowns(np.zeros((self.batch, self.nodes, 3)), np.zeros((self.batch, self.nodes)))

    @cached_property
    def _elements(self) -> int:
        return len(self.mesh.tets)

    def _device_state(self, state: Unknowns, active: np.ndarray) -> tuple[wp.array, wp.array, wp.array]:
        return (
            warp_array(state.u, wp.vec3d, self.device),
            warp_array(state.p, wp.float64, self.device),
            warp_array(active.astype(np.int32), wp.int32, self.device),
        )

    def balance(self, state: Unknowns, indenters: Indenters, active: np.ndarray) -> Balance:
        """Residual of the active samples (others: zeros)."""
        u, p, mask = self._device_state(state, active)
        force = wp.zeros((self.batch, self.nodes), dtype=wp.vec3d, device=self.device)
        volume = wp.zeros((self.batch, self.nodes), dtype=wp.float64, device=self.device)
        jacobian = wp.full((self.batch, self._elements), 1.0, dtype=wp.float64, device=self.device)
        wp.launch(
            bulk_residual,
            (self.batch, self._elements),
            inputs=[u, p, mask, *self._bulk],
            outputs=[force, volume, jacobian],
            device=self.device,
        )
        wp.launch(
            contact_residual,
            self.gap.shape[:2],
            inputs=[u, mask, self._faces, indenters, self.contact, self.penalty],
            outputs=[force, self.gap, self.tangential, self.traction],
            device=self.device,
        )
        reaction = force.numpy()
        full = [reaction.reshape(self.batch, -1)] + ([volume.numpy()] if self.mixed else [])
        # Indexing columns leaves them strided, and sums over a row would then depend on the size of the batch.
        free = np.ascontiguousarray(np.concatenate(full, axis=1)[:, self.free])
        return Balance(free, reaction, jacobian.numpy().min(axis=1))

    def tangent(self, state: Unknowns, indenters: Indenters, active: np.ndarray) -> FloatArray:
        """CSR values (B, nnz) of the derivative of the free residual."""
        u, p, mask = self._device_state(state, active)
        self._values.zero_()
        wp.launch(
            bulk_tangent,
            (self.batch, self._elements),
            inputs=[u, p, mask, *self._bulk, self._element_slot],
            outputs=[self._values],
            device=self.device,
        )
        wp.launch(
            contact_tangent,
            self.gap.shape[:2],
            inputs=[u, mask, self._faces, indenters, self.contact, self.penalty, self._face_slot],
            outputs=[self._values],
            device=self.device,
        )
        return np.asarray(self._values.numpy()[:, :-1])

    def newton_step(self, values: FloatArray, residual: FloatArray, active: np.ndarray) -> Unknowns:
        """-K^-1 r of each active sample; NaN where the matrix is singular."""
        step = self.zero()
        full = np.zeros(3 * self.nodes + (self.nodes if self.mixed else 0))
        if self._solver is None:
            self._solver = direct_solver(self.indptr, self.indices, self.symmetric)
        for s in np.flatnonzero(active):
            full[self.free] = -self._solver.solve(values[s], residual[s])
            step.u[s] = full[: 3 * self.nodes].reshape(-1, 3)
            if self.mixed:
                step.p[s] = full[3 * self.nodes :]
        return step

    def augment(self, state: Unknowns, indenters: Indenters, active: np.ndarray) -> None:
        """Augmented-Lagrangian update of the active samples at the last balance."""
        self._launch_contact(augment, state, indenters, active)

    def settle(self, state: Unknowns, indenters: Indenters, active: np.ndarray) -> None:
        """Accept the step of the active samples: friction's anchors follow."""
        self._launch_contact(settle, state, indenters, active)

    def _launch_contact(self, kernel: wp.Kernel, state: Unknowns, indenters: Indenters, active: np.ndarray) -> None:
        u, _, mask = self._device_state(state, active)
        wp.launch(
            kernel,
            self.gap.shape,
            inputs=[u, mask, self._faces, indenters, self.gap, self.tangential, self.penalty, self.contact],
            device=self.device,
        )

    def deepest(self) -> FloatArray:
        """(B,) largest penetration at the last balance, mm."""
        return np.maximum(0.0, -self.gap.numpy().min(axis=(1, 2)))

    def forces(self, state: Unknowns) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the indenter on the gel at the last balance, in units of E.

        Returns:
            (B, 3) force in E mm²; (B, 3) moment about the frame's origin in E mm³; (B, s, 3) traction at the contact
            nodes (E, per undeformed area), the mean of the quadrature points weighted by the node's shape function.
        """
        shape, weight = self._faces.shape.numpy(), self._faces.weight.numpy()
        traction = self.traction.numpy()
        position = (self.mesh.points + state.u)[:, self._face_nodes]
        arm = np.einsum("qa,sfac->sfqc", shape, position)
        force = np.einsum("fq,sfqc->sc", weight, traction)
        moment = np.einsum("fq,sfqc->sc", weight, np.cross(arm, traction))
        local = self.mesh.contact_faces.faces
        share = np.einsum("fq,qa->fa", weight, shape)
        nodal = np.einsum("fq,qa,sfqc->sfac", weight, shape, traction)
        count = len(self.mesh.contact_nodes)
        area, total = np.zeros(count), np.zeros((self.batch, count, 3))
        np.add.at(area, local, share)
        for s in range(self.batch):
            np.add.at(total[s], local, nodal[s])
        return force, moment, total / area[:, None]
