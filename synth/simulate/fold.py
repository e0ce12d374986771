r"""Quadratic elements kept from folding: a barrier at points where the bulk is not integrated, as Warp kernels.

The bulk sees det F at four points of a P2 element. Under an edge that the mesh does not resolve det F can be positive
there and negative at a corner, so that the surface folds over. At the points of a lattice of degree LATTICE over the
element (its corners, edges and faces among them) an energy per undeformed volume

.. math::  ψ(J) = \frac{μ}{3} t^3,  \quad t = \max(0, \ln (J_0 / J)), \qquad
           J ψ' = -μ t^2, \quad J^2 ψ'' + J ψ' = 2 μ t

grows to infinity as J = det F falls to 0; each point has an equal share of the volume. Where J >= J_0 everywhere,
which is where a mesh resolves what happens, nothing is added and results are the same to the bit. ψ is twice
continuously differentiable. det F > 0 is asked at these points, too.

F is linear in an element, so that four corners give it everywhere. With h_a = F^{-T} g_a, as in
`synth.simulate.bulk`: r_a = ∫ J ψ' h_a and K_ab = ∫ (J² ψ'' + J ψ') h_a h_b^T - J ψ' h_b h_a^T.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fast_math": False})

ONSET = 0.4
"""J_0. The bulk's points of deep draws come down to 0.15; 0.3 to 0.5 gave the same forces within 0.2 %."""
LATTICE = 3
_ONSET = wp.constant(wp.float64(ONSET))


@wp.struct
class Lattice:
    """Tables of a pad's quadratic elements.

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
def _at_corner(lattice: Lattice, u: wp.array2d(dtype=wp.vec3d), s: int, e: int, i: int) -> wp.mat33d:
    """F at corner i. An edge from it to corner j has the slope 4 u_middle - 3 u_i - u_j per unit of coordinate j."""
    F = wp.identity(n=3, dtype=wp.float64)
    own = u[s, lattice.nodes[e, i]]
    for a in range(4, 10):
        j = lattice.along[i, a]
        if j >= 0:
            edge = wp.float64(4.0) * u[s, lattice.nodes[e, a]] - wp.float64(3.0) * own - u[s, lattice.nodes[e, j]]
            F += wp.outer(edge, lattice.gradient[e, j])
    return F


@wp.func
def _shape_gradient(lattice: Lattice, at: wp.vec4d, e: int, a: int) -> wp.vec3d:
    g = wp.vec3d()
    for i in range(4):
        if lattice.along[i, a] >= 0:
            g += (at[i] * lattice.share[i, a]) * lattice.gradient[e, lattice.along[i, a]]
    return g


@wp.kernel
def fold_residual(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    lattice: Lattice,
    residual: wp.array2d(dtype=wp.vec3d),
    jacobian: wp.array2d(dtype=wp.float64),
):
    """One thread per (sample, element), after `bulk_residual`; jacobian: its smallest det F, lowered."""
    s, e = wp.tid()
    if active[s] == 0:
        return
    F0 = _at_corner(lattice, u, s, e, 0)
    F1 = _at_corner(lattice, u, s, e, 1)
    F2 = _at_corner(lattice, u, s, e, 2)
    F3 = _at_corner(lattice, u, s, e, 3)
    smallest = jacobian[s, e]
    for p in range(lattice.at.shape[0]):
        at = lattice.at[p]
        F = at[0] * F0 + at[1] * F1 + at[2] * F2 + at[3] * F3
        J = wp.determinant(F)
        smallest = wp.min(smallest, J)
        if wp.float64(0.0) < J and J < _ONSET:
            t = wp.log(_ONSET / J)
            pull = -lattice.weight[e] * t * t
            Fit = wp.transpose(wp.inverse(F))
            for a in range(10):
                wp.atomic_add(residual, s, lattice.nodes[e, a], pull * (Fit * _shape_gradient(lattice, at, e, a)))
    jacobian[s, e] = smallest


@wp.kernel
def fold_tangent(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    lattice: Lattice,
    pairs: wp.array(dtype=wp.vec2i),
    slot: wp.array3d(dtype=wp.int32),
    values: wp.array2d(dtype=wp.float64),
):
    """One thread per (sample, element); adds to the sparse values as `synth.simulate.bulk.bulk_tangent`."""
    s, e = wp.tid()
    if active[s] == 0:
        return
    F0 = _at_corner(lattice, u, s, e, 0)
    F1 = _at_corner(lattice, u, s, e, 1)
    F2 = _at_corner(lattice, u, s, e, 2)
    F3 = _at_corner(lattice, u, s, e, 3)
    for p in range(lattice.at.shape[0]):
        at = lattice.at[p]
        F = at[0] * F0 + at[1] * F1 + at[2] * F2 + at[3] * F3
        J = wp.determinant(F)
        if J < _ONSET:
            t = wp.log(_ONSET / J)
            along = wp.float64(2.0) * t * lattice.weight[e]
            across = t * t * lattice.weight[e]
            Fit = wp.transpose(wp.inverse(F))
            for k in range(pairs.shape[0]):
                ha = Fit * _shape_gradient(lattice, at, e, pairs[k][0])
                hb = Fit * _shape_gradient(lattice, at, e, pairs[k][1])
                block = along * wp.outer(ha, hb) + across * wp.outer(hb, ha)
                for i in range(3):
                    for j in range(3):
                        wp.atomic_add(values, s, slot[e, k, 3 * i + j], block[i, j])
