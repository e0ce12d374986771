"""A GPU's noise, on a CPU: the preconditioner's product with every number off by some share.

What two devices round otherwise makes directions of Newton's method differ by as much as linear solves leave, and a
draw whose contact is not resolved by the mesh may then end in another balance. TF32's rounding of the factors alone
shows nothing of that: it moves displacements by 1e-9, where an H200 moved them by 2e-7 in the median of 254 draws and
sent a quarter of them another way. A tenth of noise on every number does the same, whatever a GPU's own source of it
is (docs/reports/batched_fem.md, Rounding).
"""

import numpy as np
import warp as wp

from synth.simulate.batched.gemm import Host


class Noisy(Host):
    """As `synth.simulate.batched.gemm.Host`, each number of a product times 1 plus share times a standard normal."""

    def __init__(self, share: float) -> None:
        self._share, self._rng = np.float32(share), np.random.default_rng(0)

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """See `synth.simulate.batched.gemm.Dense`."""
        super().product(a, x, c, wanted)
        found = c.numpy()
        for s in np.flatnonzero(wanted.numpy() == 1):
            found[s] *= 1 + self._share * self._rng.standard_normal(found.shape[1], dtype=np.float32)
