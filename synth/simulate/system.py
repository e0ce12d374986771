"""The discrete system of one pad: unknowns, residual, tangent, Newton direction.

Unknowns: 3 displacements per node, then the pressures (none for displacement-only foams); held ones keep their value.
Everything is in units of the gel's Young's modulus, so stiffness never enters the conditioning: a pad a thousand times
stiffer deforms identically.

The kernels are those of the batched solver, too: their arrays have a leading axis, here of length one.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.bulk import bulk_residual
from synth.simulate.contact_friction import (
    FAR,
    ContactState,
    Indenters,
    contact_residual,
    contact_stiffness,
    contact_tangent,
)
from synth.simulate.inversion_barrier import barrier_residual, barrier_tangent
from synth.simulate.linear import LinearSolver
from synth.simulate.material import Material
from synth.simulate.multipliers import augment, update_contact_history
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.pattern import pattern_of
from synth.simulate.space import Space
from synth.simulate.stiffness import bulk_tangent, linearise, pressure_tangent, viscous_force
from synth.simulate.tables import (
    barrier_tables,
    bulk_tables,
    face_tables,
    laplace_table,
    nodal_weights,
    warp_array,
    zeros_of,
)


@dataclass(frozen=True)
class Unknowns:
    """State of a pad: displacement (n, 3) mm and pressure (k,) in units of E."""

    u: FloatArray
    p: FloatArray

    def plus(self, step: "Unknowns", scale: float) -> "Unknowns":
        """This plus scale times step."""
        return Unknowns(self.u + scale * step.u, self.p + scale * step.p)


@dataclass(frozen=True)
class Residual:
    """Residual of the equilibrium equations: (k,) of the unknowns that are not held; meaningless where det F <= 0.

    `nodal_forces` (n, 3), E mm², are those on all nodes; on held ones they are the reaction. At the contact points, as
    Warp arrays (1, f, nq): `gap`, mm; `traction` on the gel and its tangential part, world axes, in units of E.
    """

    free: FloatArray
    nodal_forces: FloatArray
    smallest_jacobian: float
    gap: wp.array
    tangential: wp.array
    traction: wp.array

    @property
    def deepest(self) -> float:
        """Largest penetration, mm."""
        return max(0.0, -float(self.gap.numpy().min()))


@dataclass(frozen=True)
class Tangent:
    """Derivative of the free residual: CSR data (nnz,) of the symmetric part's upper triangle, and the unsymmetric.

    That is friction's, SciPy CSR over the free unknowns, or None.
    """

    values: FloatArray
    remainder: Any


class System:
    """Kernels, arrays and sparse pattern of one pad, its space and its elements' material; see the module's docstring.

    Of the options precision and use of the linear solver's factors count.
    """

    def __init__(self, space: Space, material: Material, options: SolverOptions = STANDARD) -> None:
        self.space = space
        self.mixed = material.mixed and space.element.has_pressure
        self._pattern = pattern_of(space, self.mixed)
        self._linear_solver = LinearSolver(self._pattern.factor(options.single_precision), options.reuse_factors)
        self._bulk = bulk_tables(space, material, self.mixed, "cpu")
        self._laplace = laplace_table(space, material, self._pattern.element_pairs)
        self._faces = face_tables(space, "cpu")
        self._barrier = barrier_tables(space, material, "cpu")
        self._active = _array(np.ones(1), wp.int32)
        self._pairs = _array(self._pattern.element_pairs, wp.vec2i)
        self._face_pairs = _array(self._pattern.face_pairs, wp.vec2i)
        self._allocate()

    @property
    def free(self) -> np.ndarray:
        """(k,) numbers of the unknowns that are not held."""
        return self._pattern.free

    def matrix(self, values: FloatArray) -> Any:
        """The upper triangle of a tangent's symmetric part as SciPy CSR."""
        size = len(self.free)
        return sp.csr_matrix((values, self._pattern.indices, self._pattern.indptr), shape=(size, size))

    def _allocate(self) -> None:
        element, count = self.space.element, len(self.space.nodes)
        self._points = points = (1, len(self.space.faces), len(element.face_weights))
        self.contact: ContactState = zeros_of(ContactState, lambda _: points, "cpu")
        self.contact.gap.fill_(FAR)
        self._stiffness = _zeros(points, wp.mat33d)
        self._remainder = _zeros(points, wp.mat33d)
        self._touching = _zeros(points[:2], wp.int32)
        at_points = (count, len(element.weights))
        self._factor, self._held = _zeros(at_points, wp.vec4d), _zeros(at_points, wp.vec4d)
        at_nodes = (*at_points, self.space.nodes.shape[1])
        self._pushed, self._drift = _zeros(at_nodes, wp.vec3d), _zeros(at_nodes, wp.vec3d)

    def zero(self) -> Unknowns:
        return Unknowns(np.zeros((len(self.space.points), 3)), np.zeros(self.space.pressures if self.mixed else 0))

    def residual(self, state: Unknowns, indenter: Indenters) -> Residual:
        """Residual of a state, with what contact does at its points."""
        u, p = _on_device(state)
        elements = (1, len(self.space.nodes))
        force, volume = _zeros((1, len(self.space.points)), wp.vec3d), _zeros((1, len(state.p)), wp.float64)
        jacobian = wp.full(elements, 1.0, dtype=wp.float64, device="cpu")
        _launch(bulk_residual, elements, u, p, self._active, self._bulk, force, volume, jacobian)
        if self._barrier is not None:
            _launch(barrier_residual, elements, u, self._active, self._barrier, force, jacobian)
        contact = [u, self._active, self._faces, indenter, self.contact]
        at_points = [wp.empty(self._points, dtype=dtype, device="cpu") for dtype in (wp.float64, wp.vec3d, wp.vec3d)]
        _launch(contact_residual, self._points[:2], *contact, force, *at_points)
        reaction = force.numpy()[0]
        full = np.concatenate([reaction.ravel(), volume.numpy()[0]])
        return Residual(full[self.free], reaction, float(jacobian.numpy().min()), *at_points)

    def tangent(self, state: Unknowns, indenter: Indenters, viscosity: float = 0.0, turn: float = np.inf) -> Tangent:
        """Derivative of the free residual, plus viscosity times `viscous_force`'s; turn: `contact_stiffness`'s most."""
        u, p = _on_device(state)
        elements, pattern = (len(self.space.nodes),), self._pattern
        factor, held, pushed, drift = self._factor, self._held, self._pushed, self._drift
        values = _zeros((pattern.size + 1,), wp.float64)
        _launch(linearise, elements, u, p, self._bulk, factor, held, pushed, drift)
        bulk = [self._bulk, self._laplace, viscosity, factor, pushed, drift, pattern.block_slot]
        _launch(bulk_tangent, elements, *bulk, values)
        if self._barrier is not None:
            _launch(barrier_tangent, elements, u, self._barrier, self._pairs, pattern.block_slot, values)
        if self.mixed:
            slots = [pattern.coupling_slot, pattern.pressure_slot]
            _launch(pressure_tangent, elements, self._bulk, held, pushed, *slots, values)
        contact = [u, self._active, self._faces, indenter, self.contact, _array(np.array([turn]), wp.float64)]
        faces, touching, remainder = self._points[:2], self._touching, self._remainder
        _launch(contact_stiffness, faces, *contact, touching, self._stiffness, remainder)
        blocks = [self._faces, self._face_pairs, touching, self._stiffness, pattern.face_slot]
        _launch(contact_tangent, (faces[1], len(pattern.face_pairs)), *blocks, values)
        return Tangent(values.numpy()[:-1], self._unsymmetric(touching.numpy()[0], remainder.numpy()[0]))

    def viscous_force(self, before: Unknowns, after: Unknowns, viscosity: float) -> FloatArray:
        """(k,) force on the free unknowns against a step with a viscosity, see `synth.simulate.policy.newton`."""
        force = _zeros((1, len(self.space.points)), wp.vec3d)
        (old, _), (new, _) = _on_device(before), _on_device(after)
        thick = _array(np.array([viscosity]), wp.float64)
        _launch(viscous_force, (1, len(self.space.nodes)), self._active, old, new, thick, self._bulk, force)
        return np.asarray(np.concatenate([force.numpy().ravel(), np.zeros_like(before.p)])[self.free])

    def _unsymmetric(self, touching: np.ndarray, remainder: FloatArray) -> Any:
        """What contact leaves over (`contact_stiffness`) as a sparse matrix, or None where nothing is."""
        rubbing = np.flatnonzero(touching == 2)
        if len(rubbing) == 0:
            return None
        shape, weight = self.space.element.face_shape, self._faces.weight.numpy()[rubbing]
        blocks = weight[:, :, None, None] * remainder[rubbing]
        pairs = np.einsum("qa,qb->qab", shape, shape).reshape(len(shape), -1)
        count, nodes = len(rubbing), shape.shape[1]
        dense = np.matmul(pairs.T, blocks.reshape(count, len(shape), 9)).reshape(count, nodes, nodes, 3, 3)
        dense = dense.transpose(0, 1, 3, 2, 4).reshape(count, 3 * nodes, 3 * nodes)
        number = self._pattern.face_unknowns[rubbing]
        row, column = np.broadcast_arrays(number[:, :, None], number[:, None, :])
        kept = (row >= 0) & (column >= 0)
        size = len(self.free)
        return sp.csr_matrix((dense[kept], (row[kept], column[kept])), shape=(size, size))

    def forget_factor(self) -> None:
        """Forget the factor of an earlier tangent, so that what follows depends on the state alone."""
        self._linear_solver.forget()

    def newton_step(self, tangent: Tangent, residual: FloatArray, rough: bool = False, reuse: bool = False) -> Unknowns:
        """-K^-1 r, r (k,) of the free unknowns; rough, reuse and NaN as in `linear.LinearSolver.solve`."""
        moves = 3 * len(self.space.points)
        full = np.zeros(moves + (self.space.pressures if self.mixed else 0))
        matrix = self.matrix(tangent.values)
        full[self.free] = -self._linear_solver.solve(matrix, tangent.remainder, residual, rough, reuse)
        return Unknowns(full[:moves].reshape(-1, 3), full[moves:])

    def augment(self, at: Residual, indenter: Indenters, share: float = 1.0) -> None:
        """Augmented-Lagrangian update at a solution, by its residual: a share of it, 1 for all of it."""
        amount = _array(np.array([share]), wp.float64)
        _launch(augment, self._points, self._active, amount, indenter, at.gap, at.tangential, self.contact)

    def update_contact_history(self, state: Unknowns, at: Residual, indenter: Indenters, new_only: int = 0) -> None:
        """Accept a step: friction's anchors follow. If new_only, points that touch for the first time are anchored.

        `at` is the residual of the state.
        """
        where, found = [self._active, self._faces, indenter], [at.gap, at.tangential]
        _launch(update_contact_history, self._points, _on_device(state)[0], *where, *found, new_only, self.contact)

    def saved_contact(self) -> dict[str, np.ndarray]:
        """Copies of what contact remembers, by their names in `ContactState`."""
        return {name: getattr(self.contact, name).numpy().copy() for name in ContactState.vars}  # type: ignore[attr-defined]

    def restore_contact(self, saved: dict[str, np.ndarray]) -> None:
        """Put the copies back, after a corrected state that the load path does not go on from."""
        for name, before in saved.items():
            getattr(self.contact, name).assign(before)

    def slip_ratio(self, at: Residual, indenter: Indenters) -> float:
        """Share of the touching area that slips: all without friction, 0 without contact."""
        weight, traction = self._faces.weight.numpy(), at.traction.numpy()[0]
        along = np.linalg.norm(at.tangential.numpy()[0], axis=2)
        pressure = np.sqrt(np.maximum((traction**2).sum(axis=2) - along**2, 0.0))
        touching = pressure > 0
        slipping = touching & (along >= (1 - 1e-6) * (indenter.friction.numpy()[0] * pressure))
        area = float((weight * touching).sum())
        return float((weight * slipping).sum()) / area if area > 0 else 0.0

    def forces(self, state: Unknowns, at: Residual) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Force, moment and traction of the indenter on the gel in a state with this residual, in units of E.

        (3,) force in E mm²; (3,) moment about the frame's origin in E mm³; (s, 3) traction at the nodes of the coated
        surface (E, per undeformed area), the mean of the quadrature points near a node, weighted by the node's
        piecewise linear function.
        """
        shape, weight = self.space.element.face_shape, self._faces.weight.numpy()
        traction = at.traction.numpy()[0]
        arm = np.einsum("qa,fac->fqc", shape, (self.space.points + state.u)[self.space.faces])
        force = np.einsum("fq,fqc->c", weight, traction)
        moment = np.einsum("fq,fqc->c", weight, np.cross(arm, traction))
        hat, number, area = nodal_weights(self.space, weight).values()
        coated, nodal = self.space.coated, np.zeros((len(area), 3))
        shares = np.einsum("fq,qa,fqc->fac", weight[coated], hat, traction[coated])
        np.add.at(nodal, number[coated], shares)
        return force, moment, nodal / area[:, None]


def _array(values: np.ndarray, dtype: type) -> wp.array:
    return warp_array(values, dtype, "cpu")


def _zeros(shape: tuple[int, ...], dtype: type) -> wp.array:
    return wp.zeros(shape, dtype=dtype, device="cpu")


def _on_device(state: Unknowns) -> tuple[wp.array, wp.array]:
    return _array(state.u[None], wp.vec3d), _array(state.p[None], wp.float64)


def _launch(kernel: wp.Kernel, threads: tuple[int, ...], *arguments: Any) -> None:
    wp.launch(kernel, threads, inputs=list(arguments), device="cpu")
