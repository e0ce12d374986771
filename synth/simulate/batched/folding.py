"""The barrier of `synth.simulate.fold` in the product of tangent and vector, as Warp kernels.

With G the vector's gradient at a lattice point where J < J_0, F^{-T} : G = δ and t = ln(J_0 / J), node a gets S g_a of

    S = w (2 t δ F^{-T} + t² F^{-T} G^T F^{-T})

Few elements come near folding, so that nothing is stored but which: the rest is evaluated again in every product.
"""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

import warp as wp

from synth.simulate.batched.product import RUNNING
from synth.simulate.fold import _ONSET, Lattice, _at_corner, _shape_gradient

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.func
def _between(lattice: Lattice, u: wp.array2d(dtype=wp.vec3d), s: int, e: int, at: wp.vec4d) -> wp.mat33d:
    """F at barycentric coordinates."""
    F = at[0] * _at_corner(lattice, u, s, e, 0)
    for i in range(1, 4):
        F += at[i] * _at_corner(lattice, u, s, e, i)
    return F


@wp.kernel
def find_folding(
    mask: wp.array(dtype=wp.int32),
    u: wp.array2d(dtype=wp.vec3d),
    lattice: Lattice,
    folding: wp.array2d(dtype=wp.int32),
):
    """One thread per (element, slot): whether det F is below the barrier's onset somewhere; (m, B)."""
    e, s = wp.tid()
    if mask[s] == 0:
        return
    F0 = _at_corner(lattice, u, s, e, 0)
    F1 = _at_corner(lattice, u, s, e, 1)
    F2 = _at_corner(lattice, u, s, e, 2)
    F3 = _at_corner(lattice, u, s, e, 3)
    found = wp.int32(0)
    for p in range(lattice.at.shape[0]):
        at = lattice.at[p]
        if wp.determinant(at[0] * F0 + at[1] * F1 + at[2] * F2 + at[3] * F3) < _ONSET:
            found = wp.int32(1)
    folding[e, s] = found


@wp.kernel
def fold_product(
    running: wp.array(dtype=wp.int32),
    folding: wp.array2d(dtype=wp.int32),
    u: wp.array2d(dtype=wp.vec3d),
    lattice: Lattice,
    row: wp.array2d(dtype=wp.int32),
    x: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
):
    """One thread per (element, slot): adds the barrier's tangent times x to y."""
    e, s = wp.tid()
    if running[s] != RUNNING or folding[e, s] == 0:
        return
    for p in range(lattice.at.shape[0]):
        at = lattice.at[p]
        F = _between(lattice, u, s, e, at)
        J = wp.determinant(F)
        if J < _ONSET:
            G = wp.mat33d()
            for a in range(10):
                first = row[e, a]
                if first >= 0:
                    v = wp.vec3d(wp.float64(x[first, s]), wp.float64(x[first + 1, s]), wp.float64(x[first + 2, s]))
                    G += wp.outer(v, _shape_gradient(lattice, at, e, a))
            t = wp.log(_ONSET / J)
            Fit = wp.transpose(wp.inverse(F))
            S = (wp.float64(2.0) * t * wp.ddot(Fit, G)) * Fit + (t * t) * (Fit * wp.transpose(G) * Fit)
            for a in range(10):
                first = row[e, a]
                if first >= 0:
                    pull = lattice.weight[e] * (S * _shape_gradient(lattice, at, e, a))
                    for i in range(3):
                        wp.atomic_add(y, first + i, s, wp.float32(pull[i]))
