"""Contact's history from one load step to the next, as Warp kernels: multipliers and friction's anchors.

The law is `synth.simulate.contact_friction`'s.
"""

import warp as wp

from synth.simulate.contact_friction import FAR, ON_CONE, ContactState, Faces, Indenters, anchor_of, position


@wp.kernel
def augment(
    active: wp.array(dtype=wp.int32),
    share: wp.array(dtype=wp.float64),
    indenters: Indenters,
    gap: wp.array3d(dtype=wp.float64),
    tangential: wp.array3d(dtype=wp.vec3d),
    state: ContactState,
):
    """Normal multipliers grow by a share (B,) of stiffness times penetration; tangential ones follow the traction.

    The next solution then needs less penetration and elastic slip.
    """
    s, f, q = wp.tid()
    if active[s] == 0:
        return
    stiffness = indenters.stiffness[s]
    before = state.normal[s, f, q]
    state.normal[s, f, q] = wp.max(wp.float64(0.0), before - share[s] * stiffness * gap[s, f, q])
    if state.anchored[s, f, q] == 1:
        held = state.tangent[s, f, q]
        now = wp.transpose(indenters.rotation[s]) * tangential[s, f, q]
        state.tangent[s, f, q] = held + share[s] * (now - held)


@wp.kernel
def update_contact_history(
    u: wp.array2d(dtype=wp.vec3d),
    active: wp.array(dtype=wp.int32),
    faces: Faces,
    indenters: Indenters,
    gap: wp.array3d(dtype=wp.float64),
    tangential: wp.array3d(dtype=wp.vec3d),
    new_only: int,
    state: ContactState,
):
    """At the end of a step: anchor new contacts, drag the anchors of slipping points along, free points that left.

    With new_only = 1 new contacts are anchored and nothing else happens.
    """
    s, f, q = wp.tid()
    if active[s] == 0 or indenters.friction[s] == wp.float64(0.0):
        return
    rotation = indenters.rotation[s]
    zero = wp.vec3d()
    y = zero
    if gap[s, f, q] < FAR:
        y = wp.transpose(rotation) * (position(faces, u, s, f, q) - indenters.centre[s])
    stiffness = indenters.stiffness[s]
    pressure = state.normal[s, f, q] - stiffness * gap[s, f, q]
    if pressure > wp.float64(0.0) and state.anchored[s, f, q] == 0:
        anchor = anchor_of(state, y, gap[s, f, q], s, f, q)
        state.tangent[s, f, q] = zero
        state.anchor[s, f, q] = wp.vec3d(anchor[0], anchor[1], anchor[2])
        state.anchored[s, f, q] = 1
    if new_only == 1:
        return
    state.place[s, f, q] = y
    state.gap[s, f, q] = gap[s, f, q]
    if pressure <= wp.float64(0.0):
        state.normal[s, f, q] = wp.float64(0.0)
        state.tangent[s, f, q] = zero
        state.anchored[s, f, q] = 0
        return
    t = wp.transpose(rotation) * tangential[s, f, q]
    if wp.length(t) >= ON_CONE * indenters.friction[s] * pressure:
        state.anchor[s, f, q] = y - (state.tangent[s, f, q] - t) / stiffness
