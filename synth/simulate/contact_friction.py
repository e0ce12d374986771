r"""Contact and Coulomb friction with a rigid indenter at surface quadrature points, as Warp kernels.

Augmented Lagrangian (Simo & Laursen 1992). At a quadrature point x with gap g, outward indenter normal n (into the
gel), and y the point in the indenter's frame:

.. math::  t_n = \max(0, λ_n - ε g), \qquad  t_T = \text{return}(P m), \quad m = λ_T - ε (y - a), \quad P = I - n n^T

where a is the point's anchor, carried by the indenter. The return map leaves |t_T| <= μ t_n: stick inside the cone,
slip along the trial direction τ outside. A point that touches during a load step is anchored where it touched: with
place y_0 and gap g_0 > 0 before the step, at a = y - ρ (y - y_0), ρ = -g / (g_0 - g). Linearisation (H is the
derivative of n, D = -∂m/∂x):

    D = ε I,  for a new point  ε (ρ I - s g_0 / (g_0 - g)² (y - y_0) n^T)
    -∂(t_n n)/∂x = s ε n n^T - t_n H
    -∂(P m)/∂x   = A = P D + (n.m) H + n (H^T m)^T                            stick
    -∂t_T/∂x     = μ s ε τ n^T + (μ t_n / |P m|) (I - τ τ^T) A                slip

The gap's gradient is s n. For a true distance s = 1 and H is symmetric, for a mesh's interpolated one only nearly. The
linear solver takes a symmetric matrix and what is left over apart (`synth.simulate.linear`): the symmetric share is
that of all terms but μ s ε τ n^T and the (y - y_0) n^T in D. Tractions are per undeformed area. Anchors and λ_T live in
the indenter's frame and so turn with it. Without friction none of this state is touched. Which points slipped is asked
again where multipliers are updated (`synth.simulate.multipliers`) and where the slip ratio is summed (`System`, and
`synth.simulate.batched.reductions`).
"""

import warp as wp

from synth.press.distance import TINY, beyond_grid, normal_derivative, shape_vector, signed_distance

ON_CONE = wp.constant(wp.float64(1.0 - 1.0e-9))
"""A point slips whose traction is this share of the limit. (Inside a kernel 1.0 - 1.0e-9 would be float32: 1.)"""


@wp.struct
class Indenters:
    """The rigid bodies of a batch.

    Attributes:
        kind, shape: (B,) as in `synth.press.distance`.
        coefficients: (B, i, j, k) B-spline coefficients of mesh indenters, else of size one.
        centre: (B,) world position of the origin of the indenter's frame, mm.
        rotation: (B,) its frame's axes as columns.
        friction: (B,) Coulomb coefficient.
        stiffness: (B,) of contact, ε, E per mm.
    """

    kind: wp.array(dtype=wp.int32)
    shape: wp.array(dtype=shape_vector)
    coefficients: wp.array4d(dtype=wp.float64)
    centre: wp.array(dtype=wp.vec3d)
    rotation: wp.array(dtype=wp.mat33d)
    friction: wp.array(dtype=wp.float64)
    stiffness: wp.array(dtype=wp.float64)


@wp.struct
class Faces:
    """Faces that can touch: nodes (f, ns), shape functions (nq, ns), weights (f, nq) in mm², undeformed nodes (n,)."""

    nodes: wp.array2d(dtype=wp.int32)
    shape: wp.array2d(dtype=wp.float64)
    weight: wp.array2d(dtype=wp.float64)
    points: wp.array(dtype=wp.vec3d)


@wp.struct
class ContactState:
    """What contact remembers, (B, f, nq), vectors in the indenter's frame.

    Attributes:
        normal, tangent: multipliers λ_n, λ_T.
        anchor: a, where anchored is 1.
        anchored: 1 for points that touched at the last accepted step.
        place, gap: y_0 and g_0 at the last accepted step.
    """

    normal: wp.array3d(dtype=wp.float64)
    tangent: wp.array3d(dtype=wp.vec3d)
    anchor: wp.array3d(dtype=wp.vec3d)
    anchored: wp.array3d(dtype=wp.int32)
    place: wp.array3d(dtype=wp.vec3d)
    gap: wp.array3d(dtype=wp.float64)


FAR = wp.constant(wp.float64(1.0e30))
"""Gap of points that were not looked at, and of points before the first step."""
NEAR = wp.constant(wp.float64(1.0))
"""Faces farther than this (mm) from the indenter are passed over; no load step is that long."""


@wp.func
def position(faces: Faces, u: wp.array2d(dtype=wp.vec3d), s: int, f: int, q: int) -> wp.vec3d:
    x = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    for a in range(faces.nodes.shape[1]):
        node = faces.nodes[f, a]
        x += faces.shape[q, a] * (faces.points[node] + u[s, node])
    return x


@wp.func
def anchor_of(state: ContactState, y: wp.vec3d, gap: wp.float64, s: int, f: int, q: int) -> wp.vec4d:
    """The anchor (indenter's frame) and ρ: 1 for an old one, 0 where the point has none."""
    if state.anchored[s, f, q] == 1:
        a = state.anchor[s, f, q]
        return wp.vec4d(a[0], a[1], a[2], wp.float64(1.0))
    before = state.gap[s, f, q]
    if gap >= wp.float64(0.0) or before <= wp.float64(0.0) or before >= FAR:
        return wp.vec4d(y[0], y[1], y[2], wp.float64(0.0))
    share = -gap / (before - gap)
    a = y - share * (y - state.place[s, f, q])
    return wp.vec4d(a[0], a[1], a[2], share)


@wp.func
def _trial(state: ContactState, y: wp.vec3d, a: wp.vec4d, stiffness: wp.float64, s: int, f: int, q: int) -> wp.vec3d:
    """The trial traction m, in the indenter's frame."""
    return state.tangent[s, f, q] - stiffness * (y - wp.vec3d(a[0], a[1], a[2]))


@wp.func
def _is_far(faces: Faces, indenters: Indenters, u: wp.array2d(dtype=wp.vec3d), s: int, f: int) -> bool:
    """Whether no point of a face can touch: its centre is farther away than its size and NEAR."""
    count = faces.nodes.shape[1]
    centre = wp.vec3d()
    for a in range(count):
        node = faces.nodes[f, a]
        centre += (faces.points[node] + u[s, node]) / wp.float64(count)
    size = wp.float64(0.0)
    for a in range(count):
        node = faces.nodes[f, a]
        size = wp.max(size, wp.length(faces.points[node] + u[s, node] - centre))
    y = wp.transpose(indenters.rotation[s]) * (centre - indenters.centre[s])
    reach = wp.float64(1.5) * size + NEAR
    if beyond_grid(indenters.kind[s], indenters.shape[s], y) > reach:
        return True
    d = signed_distance(indenters.kind[s], indenters.shape[s], y, s, indenters.coefficients)
    return d[3] > reach


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
    stiffness = indenters.stiffness[s]
    far = _is_far(faces, indenters, u, s, f)
    for q in range(faces.weight.shape[1]):
        if far:
            gap[s, f, q] = FAR
            tangential[s, f, q] = wp.vec3d()
            traction[s, f, q] = wp.vec3d()
            continue
        x = position(faces, u, s, f, q)
        y = wp.transpose(rotation) * (x - indenters.centre[s])
        d = signed_distance(indenters.kind[s], indenters.shape[s], y, s, indenters.coefficients)
        gap[s, f, q] = d[3]
        t = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
        along = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
        pressure = state.normal[s, f, q] - stiffness * d[3]
        if pressure > wp.float64(0.0):
            n = rotation * wp.vec3d(d[0], d[1], d[2])
            t = pressure * n
            anchor = anchor_of(state, y, d[3], s, f, q)
            if indenters.friction[s] > wp.float64(0.0) and anchor[3] > wp.float64(0.0):
                m = rotation * _trial(state, y, anchor, stiffness, s, f, q)
                along = _returned(m - wp.dot(n, m) * n, indenters.friction[s] * pressure)
                t += along
            for a in range(faces.nodes.shape[1]):
                wp.atomic_sub(residual, s, faces.nodes[f, a], (faces.weight[f, q] * faces.shape[q, a]) * t)
        tangential[s, f, q] = along
        traction[s, f, q] = t


@wp.kernel
def contact_stiffness(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    faces: Faces,
    indenters: Indenters,
    state: ContactState,
    max_turn: wp.array(dtype=wp.float64),
    touching: wp.array2d(dtype=wp.int32),
    symmetric: wp.array3d(dtype=wp.mat33d),
    remainder: wp.array3d(dtype=wp.mat33d),
):
    """One thread per (sample, face): -∂t/∂x at its points, as a symmetric matrix and what is left over.

    touching: (B, f) 0: nothing touches, the matrices are not written; 1: nothing is left over; 2: something is.
    max_turn: (B,) most (rad) that H turns a mesh's normal over what a point is deeper than its multiplier says.
    """
    s, f = wp.tid()
    if active[s] == 0:
        return
    touching[s, f] = 0
    if _is_far(faces, indenters, u, s, f):
        return
    rotation = indenters.rotation[s]
    friction = indenters.friction[s]
    stiffness = indenters.stiffness[s]
    identity = wp.identity(n=3, dtype=wp.float64)
    zero = wp.mat33d()
    half = wp.float64(0.5)
    for q in range(faces.weight.shape[1]):
        symmetric[s, f, q] = zero
        remainder[s, f, q] = zero
        x = position(faces, u, s, f, q)
        y = wp.transpose(rotation) * (x - indenters.centre[s])
        d = signed_distance(indenters.kind[s], indenters.shape[s], y, s, indenters.coefficients)
        pressure = state.normal[s, f, q] - stiffness * d[3]
        if pressure > wp.float64(0.0):
            n = rotation * wp.vec3d(d[0], d[1], d[2])
            local, steep = normal_derivative(indenters.kind[s], indenters.shape[s], y, s, indenters.coefficients)
            H = rotation * local * wp.transpose(rotation)
            touching[s, f] = wp.max(touching[s, f], 1)
            if indenters.kind[s] == 5:
                touching[s, f] = 2
                whole = state.normal[s, f, q] + max_turn[s] * stiffness / wp.max(wp.sqrt(wp.ddot(H, H)), TINY)
                H = wp.min(whole / pressure, wp.float64(1.0)) * H
            block = (stiffness * steep) * wp.outer(n, n) - pressure * H
            remainder[s, f, q] = half * (block - wp.transpose(block))
            anchor = anchor_of(state, y, d[3], s, f, q)
            if friction > wp.float64(0.0) and anchor[3] > wp.float64(0.0):
                touching[s, f] = 2
                m = rotation * _trial(state, y, anchor, stiffness, s, f, q)
                tangential = m - wp.dot(n, m) * n
                length = wp.length(tangential)
                limit = friction * pressure
                P = identity - wp.outer(n, n)
                A = (stiffness * anchor[3]) * P + wp.dot(n, m) * H + wp.outer(n, wp.transpose(H) * m)
                fresh = zero
                if state.anchored[s, f, q] == 0:
                    before = state.gap[s, f, q]
                    slope = steep * before / ((before - d[3]) * (before - d[3]))
                    fresh = (-stiffness * slope) * wp.outer(P * (rotation * (y - state.place[s, f, q])), n)
                onto = identity
                rest = zero
                if length > limit:
                    tau = tangential / length
                    onto = (limit / length) * (identity - wp.outer(tau, tau))
                    rest = (friction * stiffness * steep) * wp.outer(tau, n)
                A = onto * A
                mean = half * (A + wp.transpose(A))
                remainder[s, f, q] += rest + onto * fresh + (A - mean)
                block += mean
            symmetric[s, f, q] = half * (block + wp.transpose(block))


@wp.kernel
def contact_tangent(
    faces: Faces,
    pairs: wp.array(dtype=wp.vec2i),
    touching: wp.array2d(dtype=wp.int32),
    symmetric: wp.array3d(dtype=wp.mat33d),
    slot: wp.array3d(dtype=wp.int32),
    values: wp.array(dtype=wp.float64),
):
    """One thread per (face, pair a <= b of its nodes); as `synth.simulate.stiffness.bulk_tangent`."""
    f, k = wp.tid()
    if touching[0, f] == 0:
        return
    a = pairs[k][0]
    b = pairs[k][1]
    block = wp.mat33d()
    for q in range(faces.weight.shape[1]):
        block += (faces.weight[f, q] * faces.shape[q, a] * faces.shape[q, b]) * symmetric[0, f, q]
    for i in range(3):
        for j in range(3):
            wp.atomic_add(values, slot[f, k, 3 * i + j], block[i, j])
