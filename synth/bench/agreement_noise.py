"""How near a draw is to another balance: the preconditioner's product with every number off by some share at random.

An H200's product of 10,000 numbers is off by 3e-5: by its sums, since the factors are rounded alike on every device.
Newton's method corrects what that changes, but for draws near a second balance, which any other rounding would decide,
too (docs/reports/batched_fem.md, Rounding).
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
