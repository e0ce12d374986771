r"""Contact and Coulomb friction with a rigid indenter at surface quadrature points, as Warp kernels.

Augmented Lagrangian (Simo & Laursen 1992). At a quadrature point x with gap g, outward indenter
normal n (into the gel):

.. math::  t_n = \max(0, λ_n - ε g), \qquad  t_T = \text{return}(P m), \quad m = λ_T - ε (x - a), \quad P = I - n n^T

where a is the point's anchor, carried by the indenter. The return map leaves |t_T| <= μ t_n: stick inside the cone,
slip along the trial direction τ outside. Linearisation (H is the derivative of n):

    -∂(t_n n)/∂x = ε n n^T - t_n H
    -∂(P m)/∂x   = A = ε P + (n.m) H + n (H m)^T                              stick
    -∂t_T/∂x     = μ ε τ n^T + (μ t_n / |P m|) (I - τ τ^T) A                  slip

Tractions are per undeformed area. A point that touches during a step has no friction until the step is accepted; its
anchor is then where it came to lie. That error vanishes with the step: a flat punch of 2 mm that slides by 0.25 mm a
step lacks 10 to 28 % of its friction, at its leading edge, a ball of 3 mm 2 to 12 %; at 0.1 mm both lack 0 to 4 %.
Anchors and λ_T live in the indenter's frame and so turn with it. Without friction none of this state is touched.
"""

import warp as wp

from synth.simulate.distance import normal_derivative, shape_vector, signed_distance

wp.set_module_options({"enable_backward": False, "fast_math": False})

ON_CONE = wp.constant(wp.float64(1.0 - 1.0e-9))
"""A point slips whose traction is this share of the limit. (Inside a kernel 1.0 - 1.0e-9 would be float32: 1.)"""


@wp.struct
class Indenters:
    """The rigid bodies of a batch.

    Attributes:
        kind, shape: (B,) as in `synth.simulate.distance`.
        coefficients: (B, i, j, k) B-spline coefficients of mesh indenters, else of size one.
        centre: (B,) world position of the origin of the indenter's frame, mm.
        rotation: (B,) its frame's axes as columns.
        friction: (B,) Coulomb coefficient.
    """

    kind: wp.array(dtype=wp.int32)
    shape: wp.array(dtype=shape_vector)
    coefficients: wp.array4d(dtype=wp.float64)
    centre: wp.array(dtype=wp.vec3d)
    rotation: wp.array(dtype=wp.mat33d)
    friction: wp.array(dtype=wp.float64)


@wp.struct
class Faces:
    """Faces that can touch: nodes (f, ns), shape functions (nq, ns), weights (f, nq) in mm², undeformed nodes (n,)."""

    nodes: wp.array2d(dtype=wp.int32)
    shape: wp.array2d(dtype=wp.float64)
    weight: wp.array2d(dtype=wp.float64)
    points: wp.array(dtype=wp.vec3d)


@wp.struct
class ContactState:
    """Multipliers and anchors (B, f, nq), vectors in the indenter's frame; anchored: 1 where it sticks or slips."""

    normal: wp.array3d(dtype=wp.float64)
    tangent: wp.array3d(dtype=wp.vec3d)
    anchor: wp.array3d(dtype=wp.vec3d)
    anchored: wp.array3d(dtype=wp.int32)


@wp.func
def _position(faces: Faces, u: wp.array2d(dtype=wp.vec3d), s: int, f: int, q: int) -> wp.vec3d:
    x = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    for a in range(faces.nodes.shape[1]):
        node = faces.nodes[f, a]
        x += faces.shape[q, a] * (faces.points[node] + u[s, node])
    return x


@wp.func
def _trial(
    state: ContactState, rotation: wp.mat33d, y: wp.vec3d, penalty: wp.float64, s: int, f: int, q: int
) -> wp.vec3d:
    """The trial traction m, in world axes."""
    return rotation * (state.tangent[s, f, q] - penalty * (y - state.anchor[s, f, q]))


@wp.func
def _returned(trial: wp.vec3d, limit: wp.float64) -> wp.vec3d:
    length = wp.length(trial)
    if length <= limit:
        return trial
    return (limit / length) * trial


@wp.kernel
def contact_residual(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    faces: Faces,
    indenters: Indenters,
    state: ContactState,
    penalty: wp.float64,
    residual: wp.array2d(dtype=wp.vec3d),
    gap: wp.array3d(dtype=wp.float64),
    tangential: wp.array3d(dtype=wp.vec3d),
    traction: wp.array3d(dtype=wp.vec3d),
):
    """One thread per (sample, face): subtracts the indenter's nodal forces.

    Writes the gap (mm), and the traction on the gel with its tangential part (world axes, in units of E).
    """
    s, f = wp.tid()
    if active[s] == 0:
        return
    rotation = indenters.rotation[s]
    for q in range(faces.weight.shape[1]):
        x = _position(faces, u, s, f, q)
        y = wp.transpose(rotation) * (x - indenters.centre[s])
        d = signed_distance(indenters.kind[s], indenters.shape[s], y, s, indenters.coefficients)
        gap[s, f, q] = d[3]
        t = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
        along = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
        pressure = state.normal[s, f, q] - penalty * d[3]
        if pressure > wp.float64(0.0):
            n = rotation * wp.vec3d(d[0], d[1], d[2])
            t = pressure * n
            if indenters.friction[s] > wp.float64(0.0) and state.anchored[s, f, q] == 1:
                m = _trial(state, rotation, y, penalty, s, f, q)
                along = _returned(m - wp.dot(n, m) * n, indenters.friction[s] * pressure)
                t += along
            for a in range(faces.nodes.shape[1]):
                wp.atomic_sub(residual, s, faces.nodes[f, a], (faces.weight[f, q] * faces.shape[q, a]) * t)
        tangential[s, f, q] = along
        traction[s, f, q] = t


@wp.kernel
def contact_tangent(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    faces: Faces,
    indenters: Indenters,
    state: ContactState,
    penalty: wp.float64,
    slot: wp.array3d(dtype=wp.int32),
    values: wp.array2d(dtype=wp.float64),
):
    """One thread per (sample, face); adds -∂t/∂x to the entries slot[f, i, j] of the sparse values."""
    s, f = wp.tid()
    if active[s] == 0:
        return
    rotation = indenters.rotation[s]
    friction = indenters.friction[s]
    identity = wp.identity(n=3, dtype=wp.float64)
    for q in range(faces.weight.shape[1]):
        x = _position(faces, u, s, f, q)
        y = wp.transpose(rotation) * (x - indenters.centre[s])
        d = signed_distance(indenters.kind[s], indenters.shape[s], y, s, indenters.coefficients)
        pressure = state.normal[s, f, q] - penalty * d[3]
        if pressure > wp.float64(0.0):
            n = rotation * wp.vec3d(d[0], d[1], d[2])
            local = normal_derivative(indenters.kind[s], indenters.shape[s], y, s, indenters.coefficients)
            H = rotation * local * wp.transpose(rotation)
            block = penalty * wp.outer(n, n) - pressure * H
            if friction > wp.float64(0.0) and state.anchored[s, f, q] == 1:
                m = _trial(state, rotation, y, penalty, s, f, q)
                tangential = m - wp.dot(n, m) * n
                length = wp.length(tangential)
                limit = friction * pressure
                A = penalty * (identity - wp.outer(n, n)) + wp.dot(n, m) * H + wp.outer(n, H * m)
                if length <= limit:
                    block += A
                else:
                    tau = tangential / length
                    block += (friction * penalty) * wp.outer(tau, n)
                    block += (limit / length) * ((identity - wp.outer(tau, tau)) * A)
            for a in range(faces.nodes.shape[1]):
                for b in range(faces.nodes.shape[1]):
                    scale = faces.weight[f, q] * faces.shape[q, a] * faces.shape[q, b]
                    for i in range(3):
                        for j in range(3):
                            wp.atomic_add(values, s, slot[f, 3 * a + i, 3 * b + j], scale * block[i, j])


@wp.kernel
def augment(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    faces: Faces,
    indenters: Indenters,
    gap: wp.array3d(dtype=wp.float64),
    tangential: wp.array3d(dtype=wp.vec3d),
    penalty: wp.float64,
    state: ContactState,
):
    """Multipliers take the present traction, so that the next solution needs less penetration and elastic slip."""
    s, f, q = wp.tid()
    if active[s] == 0:
        return
    state.normal[s, f, q] = wp.max(wp.float64(0.0), state.normal[s, f, q] - penalty * gap[s, f, q])
    if state.anchored[s, f, q] == 1:
        state.tangent[s, f, q] = wp.transpose(indenters.rotation[s]) * tangential[s, f, q]


@wp.kernel
def settle(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    faces: Faces,
    indenters: Indenters,
    gap: wp.array3d(dtype=wp.float64),
    tangential: wp.array3d(dtype=wp.vec3d),
    penalty: wp.float64,
    state: ContactState,
):
    """At the end of a step: anchor new contacts, drag the anchors of slipping points along, free points that left."""
    s, f, q = wp.tid()
    if active[s] == 0 or indenters.friction[s] == wp.float64(0.0):
        return
    rotation = indenters.rotation[s]
    pressure = state.normal[s, f, q] - penalty * gap[s, f, q]
    zero = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    if pressure <= wp.float64(0.0):
        state.normal[s, f, q] = wp.float64(0.0)
        state.tangent[s, f, q] = zero
        state.anchored[s, f, q] = 0
        return
    y = wp.transpose(rotation) * (_position(faces, u, s, f, q) - indenters.centre[s])
    if state.anchored[s, f, q] == 0:
        state.tangent[s, f, q] = zero
        state.anchor[s, f, q] = y
        state.anchored[s, f, q] = 1
        return
    t = wp.transpose(rotation) * tangential[s, f, q]
    if wp.length(t) >= ON_CONE * indenters.friction[s] * pressure:
        state.anchor[s, f, q] = y - (state.tangent[s, f, q] - t) / penalty
