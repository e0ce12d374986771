r"""Residual and tangent of a nearly incompressible neo-Hookean solid in displacement and pressure, as Warp kernels.

.. math::  Π = ∫ μ/2 (I_1 - 3 - 2 \ln J) + p (J - 1) - p²/(2λ) \,dV - \sum_e α/(2μ) |p - Π_0 p|²_e

(Simo & Taylor's perturbed Lagrangian form; stabilised as in `synth.simulate.element`.) With g_a the undeformed gradient
of shape function a and h_a = F^{-T} g_a:

    r_a  = ∫ μ F g_a + (pJ - μ) h_a
    K_ab = ∫ μ g_a.g_b I + (μ - pJ) h_b h_a^T + pJ h_a h_b^T          K_ac = ∫ J h_a N_c

Where `bulk_modulus` is negative the pressure is a field of its own; otherwise it is λ (J - 1) at each quadrature point
(displacement-only, for compressible foams), K_ab gains λ J² h_a h_b^T and the pressure rows are left empty.
float64; leading axis of every state array is the batch; stresses are relative to the pad's Young's modulus.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.kernel
def bulk_residual(
    u: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.float64),
    active: wp.array(dtype=wp.int32),
    nodes: wp.array2d(dtype=wp.int32),
    pressure_nodes: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    weight: wp.array2d(dtype=wp.float64),
    pressure_shape: wp.array2d(dtype=wp.float64),
    pressure_matrix: wp.array3d(dtype=wp.float64),
    mu: wp.array(dtype=wp.float64),
    bulk_modulus: wp.array(dtype=wp.float64),
    residual_u: wp.array2d(dtype=wp.vec3d),
    residual_p: wp.array2d(dtype=wp.float64),
    jacobian: wp.array2d(dtype=wp.float64),
):
    """One thread per (sample, element). jacobian: its smallest det F; where that is <= 0 no residual is added."""
    s, e = wp.tid()
    if active[s] == 0:
        return
    mixed = bulk_modulus[e] < wp.float64(0.0)
    bulk = wp.max(bulk_modulus[e], wp.float64(0.0))
    smallest = wp.float64(1.0e30)
    for q in range(weight.shape[1]):
        F = wp.identity(n=3, dtype=wp.float64)
        for a in range(nodes.shape[1]):
            F += wp.outer(u[s, nodes[e, a]], gradient[e, q, a])
        J = wp.determinant(F)
        smallest = wp.min(smallest, J)
        if wp.float64(0.0) < J:
            w = weight[e, q]
            Fit = wp.transpose(wp.inverse(F))
            pressure = bulk * (J - wp.float64(1.0))
            if mixed:
                for c in range(4):
                    pressure += pressure_shape[q, c] * p[s, pressure_nodes[e, c]]
                    wp.atomic_add(residual_p, s, pressure_nodes[e, c], w * (J - wp.float64(1.0)) * pressure_shape[q, c])
            volumetric = w * (pressure * J - mu[e])
            for a in range(nodes.shape[1]):
                force = (w * mu[e]) * (F * gradient[e, q, a]) + volumetric * (Fit * gradient[e, q, a])
                wp.atomic_add(residual_u, s, nodes[e, a], force)
    jacobian[s, e] = smallest
    if mixed:
        for c in range(4):
            row = wp.float64(0.0)
            for d in range(4):
                row += pressure_matrix[e, c, d] * p[s, pressure_nodes[e, d]]
            wp.atomic_add(residual_p, s, pressure_nodes[e, c], row)


@wp.kernel
def bulk_tangent(
    u: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.float64),
    active: wp.array(dtype=wp.int32),
    nodes: wp.array2d(dtype=wp.int32),
    pressure_nodes: wp.array2d(dtype=wp.int32),
    gradient: wp.array3d(dtype=wp.vec3d),
    weight: wp.array2d(dtype=wp.float64),
    pressure_shape: wp.array2d(dtype=wp.float64),
    pressure_matrix: wp.array3d(dtype=wp.float64),
    mu: wp.array(dtype=wp.float64),
    bulk_modulus: wp.array(dtype=wp.float64),
    slot: wp.array3d(dtype=wp.int32),
    values: wp.array2d(dtype=wp.float64),
):
    """One thread per (sample, element); adds the element's matrix to the entries slot[e, i, j] of the sparse values.

    Local unknowns: 3 per displacement node, then 4 pressures. Entries of held unknowns share one slot past the end.
    """
    s, e = wp.tid()
    if active[s] == 0:
        return
    mixed = bulk_modulus[e] < wp.float64(0.0)
    bulk = wp.max(bulk_modulus[e], wp.float64(0.0))
    count = nodes.shape[1]
    for q in range(weight.shape[1]):
        F = wp.identity(n=3, dtype=wp.float64)
        for a in range(count):
            F += wp.outer(u[s, nodes[e, a]], gradient[e, q, a])
        J = wp.determinant(F)
        Fit = wp.transpose(wp.inverse(F))
        w = weight[e, q]
        pressure = bulk * (J - wp.float64(1.0))
        if mixed:
            for c in range(4):
                pressure += pressure_shape[q, c] * p[s, pressure_nodes[e, c]]
        pJ = pressure * J
        for a in range(count):
            ha = Fit * gradient[e, q, a]
            for b in range(count):
                hb = Fit * gradient[e, q, b]
                diagonal = w * mu[e] * wp.dot(gradient[e, q, a], gradient[e, q, b])
                block = (w * (mu[e] - pJ)) * wp.outer(hb, ha)
                block += (w * (pJ + bulk * J * J)) * wp.outer(ha, hb)
                for i in range(3):
                    for j in range(3):
                        entry = block[i, j]
                        if i == j:
                            entry += diagonal
                        wp.atomic_add(values, s, slot[e, 3 * a + i, 3 * b + j], entry)
            if mixed:
                for c in range(4):
                    coupling = (w * J * pressure_shape[q, c]) * ha
                    for i in range(3):
                        wp.atomic_add(values, s, slot[e, 3 * a + i, 3 * count + c], coupling[i])
                        wp.atomic_add(values, s, slot[e, 3 * count + c, 3 * a + i], coupling[i])
    if mixed:
        for c in range(4):
            for d in range(4):
                wp.atomic_add(values, s, slot[e, 3 * count + c, 3 * count + d], pressure_matrix[e, c, d])
