"""A batch's unknowns, their residual and its derivative, as NumPy arrays."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.arrays import FloatArray


@dataclass(frozen=True)
class Unknowns:
    """State of a batch: displacement (B, n, 3) mm and pressure (B, k) in units of E."""

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

    def where(self, mask: np.ndarray, other: "Balance") -> "Balance":
        """This where mask (B,) is true, else other."""
        return Balance(
            np.where(mask[:, None], self.free, other.free),
            np.where(mask[:, None, None], self.reaction, other.reaction),
            np.where(mask, self.smallest_jacobian, other.smallest_jacobian),
        )


@dataclass(frozen=True)
class Tangent:
    """Derivative of the free residual of a batch.

    Attributes:
        values: (B, nnz) CSR data of the symmetric part's upper triangle.
        remainder: per sample the unsymmetric rest of friction, SciPy CSR over the free unknowns, or None.
    """

    values: FloatArray
    remainder: tuple[Any, ...]
