"""A GPU's rounding, on a CPU: the preconditioner's product with its factors rounded to TF32.

Of all that two devices round differently this is by far the most: 5e-4 of a factor, against 6e-8 in the products with
the tangent and 1e-16 in residuals. (Noise of 1e-15 on the residual of sixteen trajectories changed no bit.)
"""

import numpy as np
import warp as wp

from synth.simulate.batched.gemm import Host


def to_tf32(values: np.ndarray) -> np.ndarray:
    """Float32 values rounded to TF32's 10 bits, to nearest, ties away from zero, as the GPU's conversion does."""
    bits = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    return ((bits + np.uint32(0x1000)) & np.uint32(0xFFFFE000)).view(np.float32)


class Rounded(Host):
    """As `synth.simulate.batched.gemm.Host`, with factors in TF32."""

    def __init__(self) -> None:
        self._rounded: tuple[int | None, np.ndarray] = None, np.zeros((0, 0), dtype=np.float32)

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """See `synth.simulate.batched.gemm.Dense`."""
        if self._rounded[0] != a.ptr:
            self._rounded = a.ptr, to_tf32(a.numpy())
        given, found = to_tf32(x.numpy()), c.numpy()
        for s in np.flatnonzero(wanted.numpy() == 1):
            found[s] = self._rounded[1] @ given[s]
