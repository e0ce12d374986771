"""The preconditioner of a whole batch: the inverse of the undeformed pad's stiffness, as one dense matrix.

All slots share a mesh, so that K_0^{-1} times all their vectors is one matrix product (a loaded P2/P1 tangent needs
8 to 40 iterations to 1e-3 with it). The inverse is found in double precision and applied in single: on CUDA by cuBLAS
with products rounded to TF32, which flexible GMRES allows for, elsewhere by NumPy, one slot after the other, so that a
slot's numbers do not depend on its neighbours.
"""

from typing import Any

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.batched.gemm import Gemm
from synth.simulate.batched.krylov import RUNNING, Krylov
from synth.simulate.contact import Indenters
from synth.simulate.system import System

PAD = 64
"""Rows are filled up to a multiple of it: matrix products of other sizes took three times as long."""


def stiffness(system: System, away: Indenters) -> FloatArray:
    """(k, k) the undeformed pad's tangent over the free unknowns; `away`: an indenter that touches nothing."""
    values = system.tangent(system.zero(), away, np.ones(1, dtype=bool)).values[0]
    upper = system.matrix(np.asarray(values, dtype=np.float64)).toarray()
    return np.asarray(upper + np.triu(upper, 1).T)


class Reference:
    """K_0^{-1} on a device, filled up with zeros to a multiple of PAD rows.

    Args:
        inverse: (k, k) float64.
        device: Warp device.
    """

    def __init__(self, inverse: FloatArray, device: str) -> None:
        self.rows = -(-len(inverse) // PAD) * PAD
        padded = np.zeros((self.rows, self.rows), dtype=np.float32)
        padded[: len(inverse), : len(inverse)] = inverse
        self.matrix = wp.array(padded, dtype=wp.float32, device=device)
        self._host = None if wp.get_device(device).is_cuda else padded
        self._gemm: Any = None if self._host is not None else Gemm(device)

    def apply(self, krylov: Krylov) -> None:
        """krylov.corrected = K_0^{-1} krylov.current, at least where a solve is running."""
        if self._host is None:
            self._gemm(self.matrix, krylov.current, krylov.corrected)
            return
        given, found = krylov.current.numpy(), krylov.corrected.numpy()
        for s in np.flatnonzero(krylov.running.numpy() == RUNNING):
            found[:, s] = self._host @ np.ascontiguousarray(given[:, s])
