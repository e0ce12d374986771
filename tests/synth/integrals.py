"""Integrals over the tetrahedra of a finite-element space, in numpy alone and apart from the solver's kernels.

The shape functions are written down anew and matched to the space's nodes by their positions; the rule is the product
of Gauss-Jacobi rules on the collapsed cube (exact to degree 2 n - 1) unless the element's own is asked for.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from closed_forms import excess
from scipy.special import roots_jacobi

from synth.arrays import FloatArray
from synth.simulate.material import Material
from synth.simulate.space import Space

HOLD = {"p2p1": 2.0, "p1p1": 0.0}
"""C of `synth.simulate.bulk`: γ is so many times the pressure, where that is compressive."""


def collapsed_rule(n: int) -> tuple[FloatArray, FloatArray]:
    """Barycentric points (n³, 4) and weights (n³,) of sum 1."""
    (x, wx), (y, wy), (z, wz) = (roots_jacobi(n, power, 0) for power in (2, 1, 0))
    x, y, z = (values.ravel() for values in np.meshgrid((x + 1) / 2, (y + 1) / 2, (z + 1) / 2, indexing="ij"))
    weights = np.einsum("i,j,k->ijk", wx, wy, wz).ravel()
    first, second, third = x, (1 - x) * y, (1 - x) * (1 - y) * z
    return np.column_stack([first, second, third, 1 - first - second - third]), weights / weights.sum()


@dataclass(frozen=True)
class Integrals:
    """Quadrature on every element of a space, at points (q, 4), the pressure's shape functions, of weights (q,)."""

    space: Space
    barycentric: FloatArray
    weights: FloatArray

    @cached_property
    def volume(self) -> FloatArray:
        """(m, q) volume of each point, mm³."""
        corners = self.space.points[self.space.nodes[:, :4]]
        return np.asarray(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))[:, None] / 6 * self.weights)

    @cached_property
    def _edges(self) -> list[tuple[int, int]]:
        """Ends of the edge whose middle is node 4, 5, ..., found by position in the first element."""
        x = self.space.points[self.space.nodes[0]]
        pairs = list(combinations(range(4), 2))
        middles = np.array([(x[i] + x[j]) / 2 for i, j in pairs])
        return [pairs[int(np.argmin(np.linalg.norm(middles - node, axis=1)))] for node in x[4:]]

    @cached_property
    def shape(self) -> FloatArray:
        """(q, nn) displacement shape functions."""
        b = self.barycentric
        if not self._edges:
            return b
        return np.column_stack([b * (2 * b - 1), *(4 * b[:, i] * b[:, j] for i, j in self._edges)])

    @cached_property
    def gradient(self) -> FloatArray:
        """(m, q, nn, 3) their undeformed gradients."""
        corners = self.space.points[self.space.nodes[:, :4]]
        homogeneous = np.concatenate([np.ones((len(corners), 4, 1)), corners], axis=2)
        slope = np.swapaxes(np.linalg.inv(homogeneous)[:, 1:], 1, 2)  # (m, 4, 3): of the barycentric coordinates
        b = self.barycentric
        local = np.tile(np.eye(4), (len(b), 1, 1))
        if self._edges:
            local = np.zeros((len(b), 10, 4))
            local[:, range(4), range(4)] = 4 * b - 1
            for k, (i, j) in enumerate(self._edges):
                local[:, 4 + k, i], local[:, 4 + k, j] = 4 * b[:, j], 4 * b[:, i]
        return np.einsum("qak,ekd->eqad", local, slope)

    @property
    def positions(self) -> FloatArray:
        return np.einsum("qa,eac->eqc", self.shape, self.space.points[self.space.nodes])

    def values(self, nodal: FloatArray) -> FloatArray:
        return np.einsum("qa,eac->eqc", self.shape, nodal[self.space.nodes])

    def deformation(self, displacement: FloatArray) -> FloatArray:
        """(m, q, 3, 3) F = I + du/dX."""
        return np.eye(3) + np.einsum("eac,eqad->eqcd", displacement[self.space.nodes], self.gradient)

    def forces(self, stress: FloatArray) -> FloatArray:
        """(n, 3) nodal forces ∫ P ∇N_a of a first Piola stress (m, q, 3, 3)."""
        element = np.einsum("eq,eqcd,eqad->eac", self.volume, stress, self.gradient, optimize=True)
        total = np.zeros_like(self.space.points)
        np.add.at(total, self.space.nodes, element)
        return total

    def norm(self, field: FloatArray) -> float:
        square = (field**2).reshape(*self.volume.shape, -1).sum(axis=-1)
        return float(np.sqrt((self.volume * square).sum()))

    def dilation(self, material: Material, F: FloatArray, nodal: FloatArray) -> tuple[FloatArray, ...]:
        """(m, q) of a mixed element: the pressure field p, D = J - 1 - p/λ, and γ, that of `synth.simulate.bulk`."""
        local = nodal[self.space.pressure_nodes]
        p, inverse = local @ self.barycentric.T, 1 / material.lame[:, None]
        gamma = HOLD[self.space.element.name] * np.maximum(0.0, -local.mean(axis=1, keepdims=True))
        with np.errstate(divide="ignore"):
            left = np.clip(0.75 - gamma * inverse, 0.0, 0.5)
            gamma = np.where(left < 0.5, (0.5 - left**2) / inverse, gamma)
        return p, np.linalg.det(F) - 1 - p * inverse, np.broadcast_to(gamma, p.shape)

    def pressure(self, material: Material, displacement: FloatArray, nodal: FloatArray) -> FloatArray:
        """(m, q) pressure that does work on the volume: p + γ D, without a pressure field λ (J - 1)."""
        F = self.deformation(displacement)
        if not material.mixed:
            return np.asarray(material.lame[:, None] * (np.linalg.det(F) - 1))
        p, D, gamma = self.dilation(material, F, nodal)
        return p + gamma * D

    def stress(self, material: Material, displacement: FloatArray, nodal: FloatArray) -> FloatArray:
        """(m, q, 3, 3) first Piola stress over E of displacements (n, 3) and pressure unknowns."""
        F = self.deformation(displacement)
        s, J, inverse = excess(F), np.linalg.det(F), np.swapaxes(np.linalg.inv(F), -1, -2)
        slope = material.shear[:, None] * (1 + 2 * material.yeoh[:, :1] * s + 3 * material.yeoh[:, 1:] * s**2)
        volumetric = self.pressure(material, displacement, nodal) * J
        return np.asarray(slope[..., None, None] * (F - inverse) + volumetric[..., None, None] * inverse)

    def energy(self, material: Material, displacement: FloatArray, nodal: FloatArray) -> float:
        """Stored energy in E mm³: W of `synth.simulate.material`, γ/2 D², and -α/2μ |p - mean(p)|² of P1/P1."""
        F = self.deformation(displacement)
        s, J = excess(F), np.linalg.det(F)
        c2, c3 = material.yeoh[:, :1], material.yeoh[:, 1:]
        density = material.shear[:, None] / 2 * (s + c2 * s**2 + c3 * s**3)
        if not material.mixed:
            return float((self.volume * (density + material.lame[:, None] / 2 * (J - 1) ** 2)).sum())
        p, D, gamma = self.dilation(material, F, nodal)
        density += p * (J - 1) - p**2 / (2 * material.lame[:, None]) + gamma / 2 * D**2
        local = nodal[self.space.pressure_nodes]
        # The mean square of a linear function in a tetrahedron is (sum p_a² + (sum p_a)²) / 20.
        roughness = ((local**2).sum(axis=1) + local.sum(axis=1) ** 2) / 20 - local.mean(axis=1) ** 2
        smoothing = self.space.element.stabilisation / (2 * material.shear) * roughness
        return float((self.volume * density).sum() - (self.volume.sum(axis=1) * smoothing).sum())


def integrals(space: Space, points: int = 4) -> Integrals:
    """By the collapsed rule of `points` per direction."""
    return Integrals(space, *collapsed_rule(points))


def own_integrals(space: Space) -> Integrals:
    """By the element's own rule: what the discrete equations mean exactly."""
    return Integrals(space, space.element.barycentric, space.element.weights)
