"""Moves of the lanes' fields between state, iterate and trial, and of what contact remembers, as Warp kernels."""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

import warp as wp

from synth.simulate.batched.lanes import (
    ACCEPT,
    FRESH,
    RELAXING,
    RESET,
    RESTORE_RECORDED,
    ROLL_BACK,
    SEARCH,
    TAKE_TRIAL,
    Lanes,
)
from synth.simulate.contact import FAR, ContactState

wp.set_module_options({"enable_backward": False, "fast_math": False})


@wp.struct
class Fields:
    """Displacement (B, n) mm and pressure (B, k) in units of E.

    Attributes:
        state, previous: the last two accepted states of the path.
        iterate, trial: of Newton's method and its line search.
        recorded: the last solution at a recorded state.
    """

    state_u: wp.array2d(dtype=wp.vec3d)
    state_p: wp.array2d(dtype=wp.float64)
    previous_u: wp.array2d(dtype=wp.vec3d)
    previous_p: wp.array2d(dtype=wp.float64)
    iterate_u: wp.array2d(dtype=wp.vec3d)
    iterate_p: wp.array2d(dtype=wp.float64)
    trial_u: wp.array2d(dtype=wp.vec3d)
    trial_p: wp.array2d(dtype=wp.float64)
    recorded_u: wp.array2d(dtype=wp.vec3d)
    recorded_p: wp.array2d(dtype=wp.float64)


@wp.kernel
def clear_fields(lanes: Lanes, fields: Fields):
    """One thread per (lane, node and then pressure): the undeformed state in fresh lanes."""
    s, i = wp.tid()
    if lanes.phase[s] != FRESH:
        return
    count = fields.state_u.shape[1]
    if i < count:
        fields.state_u[s, i] = wp.vec3d()
        fields.previous_u[s, i] = wp.vec3d()
        fields.iterate_u[s, i] = wp.vec3d()
    else:
        fields.state_p[s, i - count] = wp.float64(0.0)
        fields.previous_p[s, i - count] = wp.float64(0.0)
        fields.iterate_p[s, i - count] = wp.float64(0.0)


@wp.kernel
def compute_trial(
    lanes: Lanes,
    mask: wp.array(dtype=wp.int32),
    step: wp.array2d(dtype=wp.float32),
    node_row: wp.array(dtype=wp.int32),
    pressure_row: wp.array(dtype=wp.int32),
    fields: Fields,
    force: wp.array2d(dtype=wp.vec3d),
    viscous: wp.array2d(dtype=wp.vec3d),
    volume: wp.array2d(dtype=wp.float64),
):
    """One thread per (lane, node and then pressure): the trial, and zeros for its residual and viscous force.

    step: (B, rows); node_row: first row of a node's displacement or -1 where it is held.
    """
    s, i = wp.tid()
    if mask[s] == 0:
        return
    scale = wp.float64(0.0)
    if lanes.phase[s] == SEARCH:
        scale = lanes.scale[s]
        if lanes.relaxing[s] == RELAXING:
            scale = lanes.share[s]
    count = fields.state_u.shape[1]
    if i < count:
        u = fields.iterate_u[s, i]
        row = node_row[i]
        if row >= 0 and scale != wp.float64(0.0):
            move = wp.vec3d(wp.float64(step[s, row]), wp.float64(step[s, row + 1]), wp.float64(step[s, row + 2]))
            u += scale * move
        fields.trial_u[s, i] = u
        force[s, i] = wp.vec3d()
        viscous[s, i] = wp.vec3d()
    else:
        k = i - count
        p = fields.iterate_p[s, k]
        if scale != wp.float64(0.0):
            p += scale * wp.float64(step[s, pressure_row[k]])
        fields.trial_p[s, k] = p
        volume[s, k] = wp.float64(0.0)


@wp.kernel
def apply_predictor(
    begun: wp.array(dtype=wp.int32),
    share: wp.float64,
    step: wp.array2d(dtype=wp.float32),
    node_row: wp.array(dtype=wp.int32),
    pressure_row: wp.array(dtype=wp.int32),
    fields: Fields,
):
    """One thread per (lane, node and then pressure): the state carried along with the indenter, 1/share times step."""
    s, i = wp.tid()
    if begun[s] == 0:
        return
    count = fields.state_u.shape[1]
    if i < count:
        row = node_row[i]
        u = fields.state_u[s, i]
        if row >= 0:
            move = wp.vec3d(wp.float64(step[s, row]), wp.float64(step[s, row + 1]), wp.float64(step[s, row + 2]))
            u += (wp.float64(1.0) / share) * move
        fields.iterate_u[s, i] = u
    else:
        k = i - count
        p = fields.state_p[s, k] + (wp.float64(1.0) / share) * wp.float64(step[s, pressure_row[k]])
        fields.iterate_p[s, k] = p


@wp.kernel
def move_fields(lanes: Lanes, touched: int, fields: Fields):
    """One thread per (lane, node and then pressure): what `lanes.move` says.

    A solution at a recorded state is put aside, in case a later pass fails: in phases of the set `touched`.
    """
    s, i = wp.tid()
    count = fields.state_u.shape[1]
    kind = lanes.move[s]
    keep = (touched >> lanes.phase[s]) & 1
    if kind == 0 and keep == 0:
        return
    if i < count:
        x = fields.iterate_u[s, i]
        if kind == TAKE_TRIAL:
            x = fields.trial_u[s, i]
        elif kind == RESTORE_RECORDED:
            x = fields.recorded_u[s, i]
        elif kind == RESET:
            x = fields.state_u[s, i]
            if lanes.predicted[s] == 1:
                x += lanes.ratio[s] * (x - fields.previous_u[s, i])
        elif kind == ACCEPT:
            fields.previous_u[s, i] = fields.state_u[s, i]
            fields.state_u[s, i] = x
        elif kind == ROLL_BACK:
            x = fields.previous_u[s, i]
            fields.state_u[s, i] = x
        fields.iterate_u[s, i] = x
        if keep == 1:
            fields.recorded_u[s, i] = x
    else:
        k = i - count
        p = fields.iterate_p[s, k]
        if kind == TAKE_TRIAL:
            p = fields.trial_p[s, k]
        elif kind == RESTORE_RECORDED:
            p = fields.recorded_p[s, k]
        elif kind == RESET:
            p = fields.state_p[s, k]
            if lanes.predicted[s] == 1:
                p += lanes.ratio[s] * (p - fields.previous_p[s, k])
        elif kind == ACCEPT:
            fields.previous_p[s, k] = fields.state_p[s, k]
            fields.state_p[s, k] = p
        elif kind == ROLL_BACK:
            p = fields.previous_p[s, k]
            fields.state_p[s, k] = p
        fields.iterate_p[s, k] = p
        if keep == 1:
            fields.recorded_p[s, k] = p


@wp.kernel
def clear_contact(lanes: Lanes, contact: ContactState):
    """One thread per (lane, face, point): nothing touched before in a fresh lane, not even what touches at once."""
    s, f, q = wp.tid()
    if lanes.phase[s] != FRESH:
        return
    contact.normal[s, f, q] = wp.float64(0.0)
    contact.tangent[s, f, q] = wp.vec3d()
    contact.anchored[s, f, q] = 0
    contact.gap[s, f, q] = FAR


@wp.struct
class SavedContact:
    """What a recorded state changes of contact and gets back: see `synth.simulate.contact`, (B, f, nq)."""

    normal: wp.array3d(dtype=wp.float64)
    tangent: wp.array3d(dtype=wp.vec3d)
    anchor: wp.array3d(dtype=wp.vec3d)
    anchored: wp.array3d(dtype=wp.int32)
    gap: wp.array3d(dtype=wp.float64)
    tangential: wp.array3d(dtype=wp.vec3d)


@wp.kernel
def save_contact(
    mask: wp.array(dtype=wp.int32),
    contact: ContactState,
    gap: wp.array3d(dtype=wp.float64),
    tangential: wp.array3d(dtype=wp.vec3d),
    kept: SavedContact,
):
    """One thread per (lane, face, point): put contact's memory and the last evaluation aside."""
    s, f, q = wp.tid()
    if mask[s] == 0:
        return
    kept.normal[s, f, q] = contact.normal[s, f, q]
    kept.tangent[s, f, q] = contact.tangent[s, f, q]
    kept.anchor[s, f, q] = contact.anchor[s, f, q]
    kept.anchored[s, f, q] = contact.anchored[s, f, q]
    kept.gap[s, f, q] = gap[s, f, q]
    kept.tangential[s, f, q] = tangential[s, f, q]


@wp.kernel
def restore_contact(
    mask: wp.array(dtype=wp.int32),
    lanes: Lanes,
    kept: SavedContact,
    contact: ContactState,
    gap: wp.array3d(dtype=wp.float64),
    tangential: wp.array3d(dtype=wp.vec3d),
):
    """One thread per (lane, face, point): put it back, where it was put aside."""
    s, f, q = wp.tid()
    if mask[s] == 0 or lanes.kept[s] == 0:
        return
    contact.normal[s, f, q] = kept.normal[s, f, q]
    contact.tangent[s, f, q] = kept.tangent[s, f, q]
    contact.anchor[s, f, q] = kept.anchor[s, f, q]
    contact.anchored[s, f, q] = kept.anchored[s, f, q]
    gap[s, f, q] = kept.gap[s, f, q]
    tangential[s, f, q] = kept.tangential[s, f, q]


@wp.kernel
def save_multipliers(
    lanes: Lanes,
    contact: ContactState,
    normal: wp.array3d(dtype=wp.float64),
    tangent: wp.array3d(dtype=wp.vec3d),
):
    """One thread per (lane, face, point): before a pass begins."""
    s, f, q = wp.tid()
    if lanes.new_share[s] == wp.float64(0.0):
        return
    normal[s, f, q] = contact.normal[s, f, q]
    tangent[s, f, q] = contact.tangent[s, f, q]


@wp.kernel
def restore_multipliers(
    lanes: Lanes,
    normal: wp.array3d(dtype=wp.float64),
    tangent: wp.array3d(dtype=wp.vec3d),
    contact: ContactState,
):
    """One thread per (lane, face, point): after a pass failed."""
    s, f, q = wp.tid()
    if lanes.move[s] != RESTORE_RECORDED:
        return
    contact.normal[s, f, q] = normal[s, f, q]
    contact.tangent[s, f, q] = tangent[s, f, q]
