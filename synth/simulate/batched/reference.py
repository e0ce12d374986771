"""The preconditioner of a whole batch: the inverse of the undeformed pad's stiffness, as one dense matrix.

All slots share a mesh, so that K_0^{-1} times all their vectors is one matrix product (a loaded P2/P1 tangent needs
8 to 40 iterations to 1e-3 with it). The inverse is found in double precision and applied in single, on CUDA with
products rounded to TF32: a preconditioner that changes a little with its argument, which flexible GMRES allows for.
"""

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.batched.gemm import Dense, dense
from synth.simulate.batched.krylov import Krylov, padded, plain
from synth.simulate.contact import Indenters
from synth.simulate.system import System


def stiffness(system: System, away: Indenters) -> FloatArray:
    """(k, k) the undeformed pad's tangent over the free unknowns; `away`: an indenter that touches nothing."""
    values = system.tangent(system.zero(), away, np.ones(1, dtype=bool)).values[0]
    upper = system.matrix(np.asarray(values, dtype=np.float64)).toarray()
    return np.asarray(upper + np.triu(upper, 1).T)


class Reference:
    """K_0^{-1} on a device, filled up with zeros to as many rows as the Krylov vectors have.

    Args:
        inverse: (k, k) float64, symmetric.
        device: Warp device.
        products: default the device's own.
    """

    def __init__(self, inverse: FloatArray, device: str, products: Dense | None = None) -> None:
        self.rows = padded(len(inverse))
        filled = np.zeros((self.rows, self.rows), dtype=np.float32)
        filled[: len(inverse), : len(inverse)] = inverse
        self.matrix = wp.array(filled, dtype=wp.float32, device=device)
        self._dense = products or dense(device)

    def precondition(self, krylov: Krylov) -> None:
        """`preconditioned` = K_0^{-1} `current`, at least where a solve is running."""
        given, found = plain(krylov.current), plain(krylov.preconditioned)
        self._dense.product(self.matrix, given, found, krylov.running)

    def turn_corrected(self, krylov: Krylov) -> None:
        """`corrected` = `preconditioned`, slots next to each other."""
        self._dense.transpose(plain(krylov.preconditioned), krylov.corrected)

    def turn_image(self, krylov: Krylov) -> None:
        """`product` = `image`, rows next to each other."""
        self._dense.transpose(krylov.image, plain(krylov.product))
