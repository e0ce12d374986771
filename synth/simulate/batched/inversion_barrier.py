"""The barrier of `synth.simulate.inversion_barrier` in the product of tangent and vector, as Warp kernels.

With G the vector's gradient at a sample point where J < J_0, F^{-T} : G = δ and t = ln(J_0 / J), node a gets S g_a of

    S = w (2 t δ F^{-T} + t² F^{-T} G^T F^{-T})

Few elements come near inversion, so that only their flags are stored: the rest is evaluated again in every product.
"""

import warp as wp

from synth.simulate.batched.krylov import RUNNING
from synth.simulate.inversion_barrier import ONSET_JACOBIAN, BarrierTables, corner_gradient, shape_gradient

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.func
def _gradient_at(barrier: BarrierTables, u: wp.array2d(dtype=wp.vec3d), s: int, e: int, at: wp.vec4d) -> wp.mat33d:
    """F at barycentric coordinates."""
    F = at[0] * corner_gradient(barrier, u, s, e, 0)
    for i in range(1, 4):
        F += at[i] * corner_gradient(barrier, u, s, e, i)
    return F


@wp.kernel
def find_inverting(
    mask: wp.array(dtype=wp.int32),
    u: wp.array2d(dtype=wp.vec3d),
    barrier: BarrierTables,
    inverting: wp.array2d(dtype=wp.int32),
):
    """One thread per (element, lane): whether det F is below the barrier's onset somewhere; (m, B)."""
    e, s = wp.tid()
    if mask[s] == 0:
        return
    F0 = corner_gradient(barrier, u, s, e, 0)
    F1 = corner_gradient(barrier, u, s, e, 1)
    F2 = corner_gradient(barrier, u, s, e, 2)
    F3 = corner_gradient(barrier, u, s, e, 3)
    found = wp.int32(0)
    for p in range(barrier.at.shape[0]):
        at = barrier.at[p]
        if wp.determinant(at[0] * F0 + at[1] * F1 + at[2] * F2 + at[3] * F3) < ONSET_JACOBIAN:
            found = wp.int32(1)
    inverting[e, s] = found


@wp.kernel
def barrier_product(
    running: wp.array(dtype=wp.int32),
    inverting: wp.array2d(dtype=wp.int32),
    u: wp.array2d(dtype=wp.vec3d),
    barrier: BarrierTables,
    row: wp.array2d(dtype=wp.int32),
    x: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
):
    """One thread per (element, lane): adds the barrier's tangent times x to y."""
    e, s = wp.tid()
    if running[s] != RUNNING or inverting[e, s] == 0:
        return
    for p in range(barrier.at.shape[0]):
        at = barrier.at[p]
        F = _gradient_at(barrier, u, s, e, at)
        J = wp.determinant(F)
        if J < ONSET_JACOBIAN:
            G = wp.mat33d()
            for a in range(10):
                first = row[e, a]
                if first >= 0:
                    v = wp.vec3d(wp.float64(x[first, s]), wp.float64(x[first + 1, s]), wp.float64(x[first + 2, s]))
                    G += wp.outer(v, shape_gradient(barrier, at, e, a))
            t = wp.log(ONSET_JACOBIAN / J)
            Fit = wp.transpose(wp.inverse(F))
            S = (wp.float64(2.0) * t * wp.ddot(Fit, G)) * Fit + (t * t) * (Fit * wp.transpose(G) * Fit)
            for a in range(10):
                first = row[e, a]
                if first >= 0:
                    pull = barrier.weight[e] * (S * shape_gradient(barrier, at, e, a))
                    for i in range(3):
                        wp.atomic_add(y, first + i, s, wp.float32(pull[i]))
