r"""Energy and residual of the bulk in displacement and pressure, as Warp kernels; tangent: `synth.simulate.stiffness`.

The energy is `synth.simulate.material`'s, stabilised as in `synth.mesh.element` and, with a pressure field p, by

.. math::  ½ γ(p) D², \qquad D = J - 1 - p/λ, \qquad γ = λ f(C \max(0, -\bar p) / λ)   (p̄: mean over the element)

Mixed elements hold D = 0 in the mean only. Under high pressure the second variation p δ²J of modes that leave that mean
alone is unstable although the gel is not (Auricchio et al., Comput. Methods Appl. Mech. Eng. 194, 2005): single
elements of fine meshes collapse. γ (δD)² holds them. D is zero for the exact solution, so that nothing is added that
the mesh resolves. f(x) is x to ¼, ½ - (¾ - x)² to ¾ and ½ from there on: in a compressible gel γ must stay below λ, and
a kink of f would be a jump of the residual, by γ_c D²/2 (at p̄ = 0, where D is small, there is one).

With g_a the undeformed gradient of shape function a, h_a = F^{-T} g_a, s = I_1 - 3 - 2 ln J, d_a = F g_a - h_a,
W' = μ/2 (1 + 2 c_2 s + 3 c_3 s²), P = p + γ D, and γ_c and γ_cd the derivatives of γ:

    r_a  = ∫ 2 W' d_a + P J h_a                 r_c = ∫ N_c (D - γ D / λ) + γ_c D²/2
    K_ab = ∫ 2 W' (g_a.g_b I + h_b h_a^T) + 4 W'' d_a d_b^T + (P J + γ J²) h_a h_b^T - P J h_b h_a^T
    K_ac = ∫ J h_a (N_c (1 - γ/λ) + γ_c D)      K_cd = ∫ -N_c N_d (1/λ - γ/λ²) - D (γ_c N_d + γ_d N_c)/λ
                                                   + γ_cd D²/2

Without a pressure field P = λ (J - 1), γ J² is λ J² and the pressure rows are left empty. Only the upper triangle of
the symmetric tangent is assembled. float64; leading axis of every state array is the batch.
"""

import warp as wp


@wp.struct
class Bulk:
    """Tables of a pad's elements."""

    nodes: wp.array2d(dtype=wp.int32)  # (m, nn) displacement nodes
    pressure_nodes: wp.array2d(dtype=wp.int32)  # (m, 4)
    gradient: wp.array3d(dtype=wp.vec3d)  # (m, nq, nn) 1/mm, undeformed gradients of the displacement's shape functions
    weight: wp.array2d(dtype=wp.float64)  # (m, nq) mm³
    pressure_shape: wp.array2d(dtype=wp.float64)  # (nq, 4)
    stabilisation: wp.array3d(dtype=wp.float64)  # (m, 4, 4) constant pressure block of `synth.mesh.element`
    shear: wp.array(dtype=wp.float64)  # (m,) μ
    compliance: wp.array(dtype=wp.float64)  # (m,) 1/λ
    mixed: int  # whether there is a pressure field
    hold: wp.float64  # C, of `synth.mesh.element`
    yeoh: wp.array(dtype=wp.vec2d)  # (m,) c_2, c_3


@wp.func
def _deformation_gradient(bulk: Bulk, u: wp.array2d(dtype=wp.vec3d), s: int, e: int, q: int) -> wp.mat33d:
    F = wp.identity(n=3, dtype=wp.float64)
    for a in range(bulk.nodes.shape[1]):
        F += wp.outer(u[s, bulk.nodes[e, a]], bulk.gradient[e, q, a])
    return F


@wp.func
def _dilation(bulk: Bulk, p: wp.array2d(dtype=wp.float64), J: wp.float64, s: int, e: int, q: int) -> wp.vec4d:
    """P, the stiffness beside J², D, and dγ/dp_c at a quadrature point."""
    zero = wp.float64(0.0)
    if bulk.mixed == 0:
        stiffness = wp.float64(1.0) / bulk.compliance[e]
        return wp.vec4d(stiffness * (J - wp.float64(1.0)), stiffness, zero, zero)
    pressure = zero
    mean = zero
    for c in range(4):
        nodal = p[s, bulk.pressure_nodes[e, c]]
        pressure += bulk.pressure_shape[q, c] * nodal
        mean += wp.float64(0.25) * nodal
    gamma = zero
    slope = zero
    if mean < zero:
        gamma = -bulk.hold * mean
        slope = wp.float64(-0.25) * bulk.hold
        share = gamma * bulk.compliance[e]
        if share > wp.float64(0.25):
            left = wp.max(wp.float64(0.75) - share, zero)
            gamma = (wp.float64(0.5) - left * left) / bulk.compliance[e]
            slope *= wp.float64(2.0) * left
    D = J - wp.float64(1.0) - pressure * bulk.compliance[e]
    return wp.vec4d(pressure + gamma * D, gamma, D, slope)


@wp.func
def _bend(bulk: Bulk, gamma: wp.float64, e: int) -> wp.float64:
    """γ_cd: the same for all c and d."""
    share = gamma * bulk.compliance[e]
    if share <= wp.float64(0.25) or share >= wp.float64(0.5):
        return wp.float64(0.0)
    return wp.float64(-0.125) * bulk.hold * bulk.hold * bulk.compliance[e]


@wp.func
def _slopes(bulk: Bulk, F: wp.mat33d, J: wp.float64, e: int) -> wp.vec2d:
    """2 W' and 4 W''."""
    yeoh = bulk.yeoh[e]
    if yeoh[0] == wp.float64(0.0) and yeoh[1] == wp.float64(0.0):
        return wp.vec2d(bulk.shear[e], wp.float64(0.0))
    s = wp.ddot(F, F) - wp.float64(3.0) - wp.float64(2.0) * wp.log(J)
    first = wp.float64(1.0) + wp.float64(2.0) * yeoh[0] * s + wp.float64(3.0) * yeoh[1] * s * s
    second = wp.float64(4.0) * yeoh[0] + wp.float64(12.0) * yeoh[1] * s
    return wp.vec2d(bulk.shear[e] * first, bulk.shear[e] * second)


@wp.kernel
def bulk_residual(
    u: wp.array2d(dtype=wp.vec3d),
    p: wp.array2d(dtype=wp.float64),
    active: wp.array(dtype=wp.int32),
    bulk: Bulk,
    residual_u: wp.array2d(dtype=wp.vec3d),
    residual_p: wp.array2d(dtype=wp.float64),
    jacobian: wp.array2d(dtype=wp.float64),
):
    """One thread per (sample, element). jacobian: its smallest det F; where that is <= 0 no residual is added."""
    s, e = wp.tid()
    if active[s] == 0:
        return
    smallest = wp.float64(1.0e30)
    for q in range(bulk.weight.shape[1]):
        F = _deformation_gradient(bulk, u, s, e, q)
        J = wp.determinant(F)
        smallest = wp.min(smallest, J)
        if wp.float64(0.0) < J:
            w = bulk.weight[e, q]
            Fit = wp.transpose(wp.inverse(F))
            dilation = _dilation(bulk, p, J, s, e, q)
            slope = _slopes(bulk, F, J, e)
            if bulk.mixed == 1:
                D = dilation[2]
                defect = w * D * (wp.float64(1.0) - dilation[1] * bulk.compliance[e])
                bias = wp.float64(0.5) * w * dilation[3] * D * D
                for c in range(4):
                    row = defect * bulk.pressure_shape[q, c] + bias
                    wp.atomic_add(residual_p, s, bulk.pressure_nodes[e, c], row)
            volumetric = w * (dilation[0] * J - slope[0])
            for a in range(bulk.nodes.shape[1]):
                g = bulk.gradient[e, q, a]
                wp.atomic_add(residual_u, s, bulk.nodes[e, a], (w * slope[0]) * (F * g) + volumetric * (Fit * g))
    jacobian[s, e] = smallest
    if bulk.mixed == 1:
        for c in range(4):
            row = wp.float64(0.0)
            for d in range(4):
                row += bulk.stabilisation[e, c, d] * p[s, bulk.pressure_nodes[e, d]]
            wp.atomic_add(residual_p, s, bulk.pressure_nodes[e, c], row)
