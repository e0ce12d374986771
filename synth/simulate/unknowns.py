"""The unknowns of a pad, their residual and its derivative, as NumPy arrays."""

from dataclasses import dataclass
from typing import Any

from synth.arrays import FloatArray


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
    """Residual of the equilibrium equations.

    Attributes:
        free: (k,) residual of the unknowns that are not held.
        reaction: (n, 3) all nodal forces including those on held nodes, in units of E mm².
        smallest_jacobian: smallest det F; the residual means nothing where it is <= 0.
    """

    free: FloatArray
    reaction: FloatArray
    smallest_jacobian: float


@dataclass(frozen=True)
class Tangent:
    """Derivative of the free residual.

    Attributes:
        values: (nnz,) CSR data of the symmetric part's upper triangle.
        remainder: the unsymmetric rest of friction, SciPy CSR over the free unknowns, or None.
    """

    values: FloatArray
    remainder: Any
