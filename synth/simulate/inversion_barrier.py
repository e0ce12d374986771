r"""Quadratic elements kept from inverting: a barrier at points where the bulk is not integrated, as Warp kernels.

The bulk sees det F at four points of a P2 element. Under an edge that the mesh does not resolve det F can be positive
there and negative at a corner, so that the surface turns inside out. At sample points on an even grid of degree
SAMPLE_DEGREE (corners, edges and faces of the element among them), an energy per undeformed volume

.. math::  ψ(J) = \frac{μ}{3} t^3,  \quad t = \max(0, \ln (J_0 / J)), \qquad
           J ψ' = -μ t^2, \quad J^2 ψ'' + J ψ' = 2 μ t

grows to infinity as J = det F falls to 0; each point has an equal share of the volume. Where J >= J_0 everywhere,
which is where a mesh resolves what happens, nothing is added and results are the same to the bit. ψ is twice
continuously differentiable. det F > 0 is asked at these points, too.

F is linear in an element, so that four corners give it everywhere. With h_a = F^{-T} g_a, as in
`synth.simulate.bulk`: r_a = ∫ J ψ' h_a and K_ab = ∫ (J² ψ'' + J ψ') h_a h_b^T - J ψ' h_b h_a^T.
"""

import warp as wp

ONSET = 0.4
"""J_0: below what a resolved mesh reaches in ordinary presses; forces hardly depend on it."""
SAMPLE_DEGREE = 3
"""Degree of the grid of sample points: 20 of them in an element."""
ONSET_JACOBIAN = wp.constant(wp.float64(ONSET))


@wp.struct
class BarrierTables:
    """The quadratic elements of a pad and the sample points in them.

    Attributes:
        nodes: (m, 10).
        at: (p,) barycentric coordinates of the points.
        share, along: (4, 10): at corner i the gradient of shape function a is share times that of coordinate along;
            -1 where it is zero.
        gradient: (m, 4) 1/mm, of the barycentric coordinates.
        weight: (m,) μ times volume over number of points.
    """

    nodes: wp.array2d(dtype=wp.int32)
    at: wp.array(dtype=wp.vec4d)
    share: wp.array2d(dtype=wp.float64)
    along: wp.array2d(dtype=wp.int32)
    gradient: wp.array2d(dtype=wp.vec3d)
    weight: wp.array(dtype=wp.float64)


@wp.func
def corner_gradient(barrier: BarrierTables, u: wp.array2d(dtype=wp.vec3d), s: int, e: int, i: int) -> wp.mat33d:
    """F at corner i. An edge from it to corner j has the slope 4 u_middle - 3 u_i - u_j per unit of coordinate j."""
    F = wp.identity(n=3, dtype=wp.float64)
    own = u[s, barrier.nodes[e, i]]
    for a in range(4, 10):
        j = barrier.along[i, a]
        if j >= 0:
            edge = wp.float64(4.0) * u[s, barrier.nodes[e, a]] - wp.float64(3.0) * own - u[s, barrier.nodes[e, j]]
            F += wp.outer(edge, barrier.gradient[e, j])
    return F


@wp.func
def corner_gradients(barrier: BarrierTables, u: wp.array2d(dtype=wp.vec3d), s: int, e: int):
    """F at the four corners."""
    F0 = corner_gradient(barrier, u, s, e, 0)
    F1 = corner_gradient(barrier, u, s, e, 1)
    F2 = corner_gradient(barrier, u, s, e, 2)
    F3 = corner_gradient(barrier, u, s, e, 3)
    return F0, F1, F2, F3


@wp.func
def shape_gradient(barrier: BarrierTables, at: wp.vec4d, e: int, a: int) -> wp.vec3d:
    g = wp.vec3d()
    for i in range(4):
        if barrier.along[i, a] >= 0:
            g += (at[i] * barrier.share[i, a]) * barrier.gradient[e, barrier.along[i, a]]
    return g


@wp.kernel
def barrier_residual(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    barrier: BarrierTables,
    residual: wp.array2d(dtype=wp.vec3d),
    jacobian: wp.array2d(dtype=wp.float64),
):
    """One thread per (sample, element), after `bulk_residual`; jacobian: its smallest det F, lowered."""
    s, e = wp.tid()
    if active[s] == 0:
        return
    F0, F1, F2, F3 = corner_gradients(barrier, u, s, e)
    smallest = jacobian[s, e]
    for p in range(barrier.at.shape[0]):
        at = barrier.at[p]
        F = at[0] * F0 + at[1] * F1 + at[2] * F2 + at[3] * F3
        J = wp.determinant(F)
        smallest = wp.min(smallest, J)
        if wp.float64(0.0) < J and J < ONSET_JACOBIAN:
            t = wp.log(ONSET_JACOBIAN / J)
            pull = -barrier.weight[e] * t * t
            Fit = wp.transpose(wp.inverse(F))
            for a in range(10):
                wp.atomic_add(residual, s, barrier.nodes[e, a], pull * (Fit * shape_gradient(barrier, at, e, a)))
    jacobian[s, e] = smallest


@wp.kernel
def barrier_tangent(
    u: wp.array2d(dtype=wp.vec3d),
    barrier: BarrierTables,
    pairs: wp.array(dtype=wp.vec2i),
    slot: wp.array3d(dtype=wp.int32),
    values: wp.array(dtype=wp.float64),
):
    """One thread per element; adds to the sparse values as `synth.simulate.stiffness.bulk_tangent`."""
    e = wp.tid()
    F0, F1, F2, F3 = corner_gradients(barrier, u, 0, e)
    for p in range(barrier.at.shape[0]):
        at = barrier.at[p]
        F = at[0] * F0 + at[1] * F1 + at[2] * F2 + at[3] * F3
        J = wp.determinant(F)
        if J < ONSET_JACOBIAN:
            t = wp.log(ONSET_JACOBIAN / J)
            along = wp.float64(2.0) * t * barrier.weight[e]
            across = t * t * barrier.weight[e]
            Fit = wp.transpose(wp.inverse(F))
            for k in range(pairs.shape[0]):
                ha = Fit * shape_gradient(barrier, at, e, pairs[k][0])
                hb = Fit * shape_gradient(barrier, at, e, pairs[k][1])
                block = along * wp.outer(ha, hb) + across * wp.outer(hb, ha)
                for i in range(3):
                    for j in range(3):
                        wp.atomic_add(values, slot[e, k, 3 * i + j], block[i, j])
