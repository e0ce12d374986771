"""Numbers as a GPU's matrix product takes them: TF32, with 8 bits for the exponent and 10 after the point.

What goes into the preconditioner is rounded before, by the same kernels on every device. An H200 then finds nothing to
round in its factors, the products of two such numbers are exact in single precision, and only their sums are left
between it and a CPU.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

HALF, KEPT = wp.constant(wp.uint32(0x1000)), wp.constant(wp.uint32(0xFFFFE000))
"""Half of the last bit that is kept, and all the bits that are."""


@wp.func
def rounded(x: wp.float32) -> wp.float32:
    """To the nearest TF32 number, away from zero between two; what is not finite stays."""
    if not wp.isfinite(x):
        return x
    return wp.cast((wp.cast(x, wp.uint32) + HALF) & KEPT, wp.float32)


@wp.func
def rounded_four(x: wp.vec4f) -> wp.vec4f:
    """See rounded."""
    return wp.vec4f(rounded(x[0]), rounded(x[1]), rounded(x[2]), rounded(x[3]))


@wp.kernel
def round_matrix(a: wp.array2d(dtype=wp.float32)):
    """In place; one thread per number."""
    i, j = wp.tid()
    a[i, j] = rounded(a[i, j])
