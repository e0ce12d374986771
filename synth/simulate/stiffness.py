"""Tangent of the bulk as a sparse matrix, for one sample, as Warp kernels: the equations of `synth.simulate.bulk`.

A thread does all blocks of an element; one for each block would spend most of its time on starting. I ∫ 2 W' g_a.g_b
depends on the deformation only where the gel stiffens; elsewhere it is a table.
"""

import warp as wp

from synth.simulate.bulk import Bulk, _bend, _deformation_gradient, _dilation, _slopes


@wp.kernel
def linearise(
    u: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.float64),
    bulk: Bulk,
    factor: wp.array2d(dtype=wp.vec4d),
    held: wp.array2d(dtype=wp.vec4d),
    pushed: wp.array3d(dtype=wp.vec3d),
    drift: wp.array3d(dtype=wp.vec3d),
):
    """One thread per element: what the blocks of `bulk_tangent` share.

    factor: (m, nq) w times 2 W', 4 W'', P J + γ J² and P J. held: (m, nq) J, γ, D, γ_c.
    pushed: (m, nq, nn) h_a. drift: d_a, filled only where 4 W'' is not zero.
    """
    e = wp.tid()
    for q in range(bulk.weight.shape[1]):
        F = _deformation_gradient(bulk, u, 0, e, q)
        J = wp.determinant(F)
        Fit = wp.transpose(wp.inverse(F))
        w = bulk.weight[e, q]
        dilation = _dilation(bulk, p, J, 0, e, q)
        PJ = dilation[0] * J
        slope = _slopes(bulk, F, J, e)
        factor[e, q] = wp.vec4d(w * slope[0], w * slope[1], w * (PJ + dilation[1] * J * J), w * PJ)
        held[e, q] = wp.vec4d(J, dilation[1], dilation[2], dilation[3])
        for a in range(bulk.nodes.shape[1]):
            h = Fit * bulk.gradient[e, q, a]
            pushed[e, q, a] = h
            if slope[1] != wp.float64(0.0):
                drift[e, q, a] = F * bulk.gradient[e, q, a] - h


@wp.kernel
def bulk_tangent(
    bulk: Bulk,
    laplace: wp.array2d(dtype=wp.float64),
    viscosity: wp.float64,
    factor: wp.array2d(dtype=wp.vec4d),
    pushed: wp.array3d(dtype=wp.vec3d),
    drift: wp.array3d(dtype=wp.vec3d),
    slot: wp.array3d(dtype=wp.int32),
    values: wp.array(dtype=wp.float64),
):
    """One thread per element: the blocks K_ab of pairs a <= b of displacement nodes.

    Adds them to the entries slot[e, pair, 3 i + j] of the sparse values; entries of held unknowns and below the
    diagonal share one slot past the end. laplace: (m, pairs) of `synth.simulate.tables.laplace_table`; so many times
    it is added again as the viscosity says, see `synth.simulate.policy.newton`.
    """
    e = wp.tid()
    yeoh = bulk.yeoh[e]
    stiffens = yeoh[0] != wp.float64(0.0) or yeoh[1] != wp.float64(0.0)
    count = bulk.nodes.shape[1]
    points = bulk.weight.shape[1]
    k = wp.int32(0)
    for a in range(count):
        for b in range(a, count):
            block = wp.mat33d()
            for q in range(points):
                f = factor[e, q]
                ha = pushed[e, q, a]
                hb = pushed[e, q, b]
                block += wp.outer(hb, (f[0] - f[3]) * ha) + wp.outer(f[2] * ha, hb)
            isotropic = laplace[e, k]
            if stiffens:
                isotropic = wp.float64(0.0)
                for q in range(points):
                    f = factor[e, q]
                    isotropic += f[0] * wp.dot(bulk.gradient[e, q, a], bulk.gradient[e, q, b])
                    if f[1] != wp.float64(0.0):
                        block += f[1] * wp.outer(drift[e, q, a], drift[e, q, b])
            for i in range(3):
                for j in range(3):
                    entry = block[i, j]
                    if i == j:
                        entry += isotropic + viscosity * laplace[e, k]
                    wp.atomic_add(values, slot[e, k, 3 * i + j], entry)
            k += 1


@wp.kernel
def pressure_tangent(
    bulk: Bulk,
    held: wp.array2d(dtype=wp.vec4d),
    pushed: wp.array3d(dtype=wp.vec3d),
    coupling_slot: wp.array3d(dtype=wp.int32),
    pressure_slot: wp.array3d(dtype=wp.int32),
    values: wp.array(dtype=wp.float64),
):
    """One thread per element: the blocks K_ac and K_cd."""
    e = wp.tid()
    count = bulk.nodes.shape[1]
    points = bulk.weight.shape[1]
    inverse = bulk.compliance[e]
    one = wp.float64(1.0)
    for a in range(count):
        coupling = wp.matrix(shape=(4, 3), dtype=wp.float64)
        for q in range(points):
            t = held[e, q]
            share = wp.vec4d()
            for c in range(4):
                share[c] = bulk.pressure_shape[q, c] * (one - t[1] * inverse) + t[3] * t[2]
            coupling += wp.outer(share, (bulk.weight[e, q] * t[0]) * pushed[e, q, a])
        for c in range(4):
            for i in range(3):
                wp.atomic_add(values, coupling_slot[e, 4 * a + c, i], coupling[c, i])
    for c in range(4):
        for d in range(c, 4):
            entry = bulk.stabilisation[e, c, d]
            for q in range(points):
                t = held[e, q]
                nc = bulk.pressure_shape[q, c]
                nd = bulk.pressure_shape[q, d]
                soft = inverse * (one - t[1] * inverse)
                bent = wp.float64(0.5) * _bend(bulk, t[1], e) * t[2] * t[2]
                entry -= bulk.weight[e, q] * (nc * nd * soft + t[2] * t[3] * inverse * (nc + nd) - bent)
            wp.atomic_add(values, pressure_slot[e, c, d], entry)
            if c != d:
                wp.atomic_add(values, pressure_slot[e, d, c], entry)


@wp.kernel
def viscous_force(
    active: wp.array(dtype=wp.int32),
    before: wp.array2d(dtype=wp.vec3d),
    after: wp.array2d(dtype=wp.vec3d),
    viscosity: wp.array(dtype=wp.float64),
    bulk: Bulk,
    force: wp.array2d(dtype=wp.vec3d),
):
    """One thread per (sample, element): adds θ L δ, with δ what the displacement (B, n) has changed by."""
    s, e = wp.tid()
    if active[s] == 0 or viscosity[s] == wp.float64(0.0):
        return
    for q in range(bulk.weight.shape[1]):
        slope = wp.mat33d()
        for a in range(bulk.nodes.shape[1]):
            node = bulk.nodes[e, a]
            slope += wp.outer(after[s, node] - before[s, node], bulk.gradient[e, q, a])
        stress = (viscosity[s] * bulk.shear[e] * bulk.weight[e, q]) * slope
        for a in range(bulk.nodes.shape[1]):
            wp.atomic_add(force, s, bulk.nodes[e, a], stress * bulk.gradient[e, q, a])
