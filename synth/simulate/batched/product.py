r"""The tangent times a vector for a whole batch, without a matrix, in single precision.

With G = Σ_b v_b ⊗ g_b the vector's gradient, δ = F^{-T} : G its dilation over J, and π its pressure, the blocks of
`synth.simulate.bulk` give, at a quadrature point of weight w,

.. math::  S = w [2W' G + (2W' - P J) F^{-T} G^T F^{-T} + ((P J + γ J²) δ + J π') F^{-T} + 4W'' η (F - F^{-T})]

with η = (F - F^{-T}) : G and π' = Σ_c π_c (N_c (1 - γ/λ) + γ_c D); node a gets S g_a, pressure c gets
w J δ (N_c (1 - γ/λ) + γ_c D) + Σ_d K_cd π_d. What depends on the state is evaluated once per Newton iteration, by the
functions of `synth.simulate.bulk` in double precision, and stored (γ_cd D²/2 in K_cd, which is small, is left out); so
is contact's 3 x 3 stiffness at touching points with its unsymmetric part, by `contact_stiffness` itself.

Vectors are (rows, B): all displacements of a free node in three rows, then the pressures, and neighbouring threads work
on neighbouring lanes of the same element, so that every access to them is one piece of memory. Elements add to a row in
no particular order on a GPU: there the last bits differ from run to run, on a CPU they do not.

The barrier of `synth.simulate.inversion_barrier` adds its own: with G the vector's gradient at a sample point where J <
J_0, F^{-T} : G = δ and t = ln(J_0 / J), node a gets S g_a of

    S = w (2 t δ F^{-T} + t² F^{-T} G^T F^{-T})

Few elements come near inversion, so that only their flags are stored: the rest is evaluated again in every product.
"""

from functools import cache

import warp as wp

from synth.simulate.batched.krylov import RUNNING
from synth.simulate.bulk import Bulk, _deformation_gradient, _dilation, _slopes
from synth.simulate.inversion_barrier import ONSET_JACOBIAN, BarrierTables, corner_gradients, shape_gradient

BLOCK, RESIDENT_BLOCKS = 128, 4
"""Threads of a block of `bulk_product`, and blocks that a multiprocessor is to run side by side: the compiler takes
fewer registers then, so that more threads wait for memory at a time."""
STORED = 16
"""Numbers stored per quadrature point: F^{-T} (9), w 2W', w (2W' - P J), w (P J + γ J²), w J (1 - γ/λ), w J γ_c D,
w (1 - γ/λ)/λ, w γ_c D/λ."""
STORED_YEOH = 26
"""With a stiffening law also w 4W'' and F - F^{-T} (9)."""


@wp.struct
class SingleTables:
    """Tables of elements and faces in single precision, and where unknowns are in a vector.

    Attributes:
        unknown: (rows,) number of a row's unknown, displacements of all nodes first; -1 where there is none.
        row: (3 n + k,) the other way round; -1 where the unknown is held.
        element_row, face_row: (m, nn), (f, ns) first rows of the displacements of their nodes; pressure_row: (m, 4).
        face_shape: (nq, ns).
        gradient, pressure_shape, stabilisation: as in `synth.simulate.bulk.Bulk`.
    """

    unknown: wp.array(dtype=wp.int32)
    row: wp.array(dtype=wp.int32)
    element_row: wp.array2d(dtype=wp.int32)
    face_row: wp.array2d(dtype=wp.int32)
    pressure_row: wp.array2d(dtype=wp.int32)
    face_shape: wp.array2d(dtype=wp.float32)
    gradient: wp.array3d(dtype=wp.vec3f)
    pressure_shape: wp.array2d(dtype=wp.float32)
    stabilisation: wp.array3d(dtype=wp.float32)


@wp.kernel
def store_bulk(
    mask: wp.array(dtype=wp.int32),
    u: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.float64),
    bulk: Bulk,
    viscosity: wp.array(dtype=wp.float64),
    stored: wp.array4d(dtype=wp.float32),
):
    """One thread per (element, lane): (m, nq, STORED, B). A viscosity θ adds θ μ to the 2W' beside G alone."""
    e, s = wp.tid()
    if mask[s] == 0:
        return
    one = wp.float64(1.0)
    inverse = bulk.compliance[e]
    for q in range(bulk.weight.shape[1]):
        F = _deformation_gradient(bulk, u, s, e, q)
        J = wp.determinant(F)
        Fit = wp.transpose(wp.inverse(F))
        w = bulk.weight[e, q]
        dilation = _dilation(bulk, p, J, s, e, q)
        slope = _slopes(bulk, F, J, e)
        PJ = dilation[0] * J
        for i in range(3):
            for j in range(3):
                stored[e, q, 3 * i + j, s] = wp.float32(Fit[i, j])
        stored[e, q, 9, s] = wp.float32(w * (slope[0] + viscosity[s] * bulk.shear[e]))
        stored[e, q, 10, s] = wp.float32(w * (slope[0] - PJ))
        stored[e, q, 11, s] = wp.float32(w * (PJ + dilation[1] * J * J))
        if bulk.mixed == 1:
            softened = one - dilation[1] * inverse
            drift = dilation[3] * dilation[2]
            stored[e, q, 12, s] = wp.float32(w * J * softened)
            stored[e, q, 13, s] = wp.float32(w * J * drift)
            stored[e, q, 14, s] = wp.float32(w * softened * inverse)
            stored[e, q, 15, s] = wp.float32(w * drift * inverse)
        if stored.shape[2] > 16:
            stored[e, q, 16, s] = wp.float32(w * slope[1])
            for i in range(3):
                for j in range(3):
                    stored[e, q, 17 + 3 * i + j, s] = wp.float32(F[i, j] - Fit[i, j])


@cache
def bulk_product(nodes: int, mixed: bool, stabilised: bool, yeoh: bool) -> wp.Kernel:
    """The kernel that adds the bulk's tangent times x to y; one thread per (element, lane).

    The number of an element's displacement nodes is known to the compiler, so that their values stay in registers.
    """
    count = wp.constant(nodes)
    nodal = wp.types.matrix(shape=(nodes, 3), dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(BLOCK, RESIDENT_BLOCKS))
    def product(
        running: wp.array(dtype=wp.int32),
        single: SingleTables,
        stored: wp.array4d(dtype=wp.float32),
        x: wp.array2d(dtype=wp.float32),
        y: wp.array2d(dtype=wp.float32),
    ):
        e, s = wp.tid()
        if running[s] != RUNNING:
            return
        v = nodal()
        r = nodal()
        for a in range(count):
            row = single.element_row[e, a]
            if row >= 0:
                v[a, 0] = x[row, s]
                v[a, 1] = x[row + 1, s]
                v[a, 2] = x[row + 2, s]
        pressure = wp.vec4f()
        rows = wp.vec4f()
        total = wp.float32(0.0)
        if wp.static(mixed):
            for c in range(4):
                pressure[c] = x[single.pressure_row[e, c], s]
                total += pressure[c]
        for q in range(single.gradient.shape[1]):
            G = wp.mat33f()
            for a in range(count):
                G += wp.outer(wp.vec3f(v[a, 0], v[a, 1], v[a, 2]), single.gradient[e, q, a])
            h = wp.mat33f(
                stored[e, q, 0, s], stored[e, q, 1, s], stored[e, q, 2, s],
                stored[e, q, 3, s], stored[e, q, 4, s], stored[e, q, 5, s],
                stored[e, q, 6, s], stored[e, q, 7, s], stored[e, q, 8, s],
            )  # fmt: skip
            dilation = wp.ddot(h, G)
            spherical = stored[e, q, 11, s] * dilation
            if wp.static(mixed):
                shape = wp.vec4f(
                    single.pressure_shape[q, 0], single.pressure_shape[q, 1],
                    single.pressure_shape[q, 2], single.pressure_shape[q, 3],
                )  # fmt: skip
                here = wp.dot(shape, pressure)
                coupling = stored[e, q, 12, s]
                drift = stored[e, q, 13, s]
                soft = stored[e, q, 14, s]
                bias = stored[e, q, 15, s]
                spherical += coupling * here + drift * total
                rows += (coupling * dilation - soft * here - bias * total) * shape
                level = drift * dilation - bias * here
                rows += wp.vec4f(level, level, level, level)
            S = stored[e, q, 9, s] * G + stored[e, q, 10, s] * (h * wp.transpose(G) * h) + spherical * h
            if wp.static(yeoh):
                d = wp.mat33f(
                    stored[e, q, 17, s], stored[e, q, 18, s], stored[e, q, 19, s],
                    stored[e, q, 20, s], stored[e, q, 21, s], stored[e, q, 22, s],
                    stored[e, q, 23, s], stored[e, q, 24, s], stored[e, q, 25, s],
                )  # fmt: skip
                S += (stored[e, q, 16, s] * wp.ddot(d, G)) * d
            for a in range(count):
                t = S * single.gradient[e, q, a]
                r[a, 0] += t[0]
                r[a, 1] += t[1]
                r[a, 2] += t[2]
        for a in range(count):
            row = single.element_row[e, a]
            if row >= 0:
                wp.atomic_add(y, row, s, r[a, 0])
                wp.atomic_add(y, row + 1, s, r[a, 1])
                wp.atomic_add(y, row + 2, s, r[a, 2])
        if wp.static(mixed):
            for c in range(4):
                if wp.static(stabilised):
                    for d in range(4):
                        rows[c] += single.stabilisation[e, c, d] * pressure[d]
                wp.atomic_add(y, single.pressure_row[e, c], s, rows[c])

    return product


@wp.kernel
def store_contact(
    mask: wp.array(dtype=wp.int32),
    touching: wp.array2d(dtype=wp.int32),
    weight: wp.array2d(dtype=wp.float64),
    symmetric: wp.array3d(dtype=wp.mat33d),
    remainder: wp.array3d(dtype=wp.mat33d),
    stored: wp.array3d(dtype=wp.mat33f),
):
    """One thread per (lane, face): w times the whole of -∂t/∂x at its points, where it touches."""
    s, f = wp.tid()
    if mask[s] == 0 or touching[s, f] == 0:
        return
    for q in range(weight.shape[1]):
        stored[s, f, q] = wp.mat33f(weight[f, q] * (symmetric[s, f, q] + remainder[s, f, q]))


@cache
def contact_product(nodes: int) -> wp.Kernel:
    """The kernel that adds contact's tangent times x to y; one thread per (lane, face of so many nodes)."""
    count = wp.constant(nodes)
    nodal = wp.types.matrix(shape=(nodes, 3), dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False)
    def product(
        running: wp.array(dtype=wp.int32),
        touching: wp.array2d(dtype=wp.int32),
        single: SingleTables,
        stored: wp.array3d(dtype=wp.mat33f),
        x: wp.array2d(dtype=wp.float32),
        y: wp.array2d(dtype=wp.float32),
    ):
        s, f = wp.tid()
        if running[s] != RUNNING or touching[s, f] == 0:
            return
        v = nodal()
        r = nodal()
        for a in range(count):
            first = single.face_row[f, a]
            if first >= 0:
                v[a, 0] = x[first, s]
                v[a, 1] = x[first + 1, s]
                v[a, 2] = x[first + 2, s]
        for q in range(single.face_shape.shape[0]):
            here = wp.vec3f()
            for a in range(count):
                here += single.face_shape[q, a] * wp.vec3f(v[a, 0], v[a, 1], v[a, 2])
            t = stored[s, f, q] * here
            for a in range(count):
                r[a, 0] += single.face_shape[q, a] * t[0]
                r[a, 1] += single.face_shape[q, a] * t[1]
                r[a, 2] += single.face_shape[q, a] * t[2]
        for a in range(count):
            first = single.face_row[f, a]
            if first >= 0:
                wp.atomic_add(y, first, s, r[a, 0])
                wp.atomic_add(y, first + 1, s, r[a, 1])
                wp.atomic_add(y, first + 2, s, r[a, 2])

    return product


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
    F0, F1, F2, F3 = corner_gradients(barrier, u, s, e)
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
    single: SingleTables,
    x: wp.array2d(dtype=wp.float32),
    y: wp.array2d(dtype=wp.float32),
):
    """One thread per (element, lane): adds the barrier's tangent times x to y."""
    e, s = wp.tid()
    if running[s] != RUNNING or inverting[e, s] == 0:
        return
    F0, F1, F2, F3 = corner_gradients(barrier, u, s, e)
    for p in range(barrier.at.shape[0]):
        at = barrier.at[p]
        F = at[0] * F0 + at[1] * F1 + at[2] * F2 + at[3] * F3
        J = wp.determinant(F)
        if J < ONSET_JACOBIAN:
            G = wp.mat33d()
            for a in range(10):
                first = single.element_row[e, a]
                if first >= 0:
                    v = wp.vec3d(wp.float64(x[first, s]), wp.float64(x[first + 1, s]), wp.float64(x[first + 2, s]))
                    G += wp.outer(v, shape_gradient(barrier, at, e, a))
            t = wp.log(ONSET_JACOBIAN / J)
            Fit = wp.transpose(wp.inverse(F))
            S = (wp.float64(2.0) * t * wp.ddot(Fit, G)) * Fit + (t * t) * (Fit * wp.transpose(G) * Fit)
            for a in range(10):
                first = single.element_row[e, a]
                if first >= 0:
                    pull = barrier.weight[e] * (S * shape_gradient(barrier, at, e, a))
                    for i in range(3):
                        wp.atomic_add(y, first + i, s, wp.float32(pull[i]))
