"""Moves of the lanes' fields between state, iterate and trial, and of contact's memory, as Warp kernels."""

from typing import Any

import warp as wp

from synth.simulate.batched import lanes as phases
from synth.simulate.batched.lanes import Lanes
from synth.simulate.contact import FAR, ContactState


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
    if lanes.phase[s] != phases.FRESH:
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


@wp.func
def node_step(step: wp.array2d(dtype=wp.float32), s: int, row: int) -> wp.vec3d:
    """A node's part of a step (B, rows), from its first row on."""
    return wp.vec3d(wp.float64(step[s, row]), wp.float64(step[s, row + 1]), wp.float64(step[s, row + 2]))


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
    if lanes.phase[s] == phases.SEARCH:
        scale = lanes.scale[s]
        if lanes.relaxing[s] > 0:
            scale = lanes.part[s]
    count = fields.state_u.shape[1]
    if i < count:
        u = fields.iterate_u[s, i]
        row = node_row[i]
        if row >= 0 and scale != wp.float64(0.0):
            u += scale * node_step(step, s, row)
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
    """One thread per (lane, node and then pressure): the first iterate, the state and 1/share times step."""
    s, i = wp.tid()
    if begun[s] == 0:
        return
    count = fields.state_u.shape[1]
    if i < count:
        row = node_row[i]
        u = fields.state_u[s, i]
        if row >= 0:
            u += (wp.float64(1.0) / share) * node_step(step, s, row)
        fields.iterate_u[s, i] = u
    else:
        k = i - count
        p = fields.state_p[s, k] + (wp.float64(1.0) / share) * wp.float64(step[s, pressure_row[k]])
        fields.iterate_p[s, k] = p


@wp.func
def _move(
    lanes: Lanes,
    keep: int,
    s: int,
    i: int,
    state: wp.array2d(dtype=Any),
    previous: wp.array2d(dtype=Any),
    iterate: wp.array2d(dtype=Any),
    trial: wp.array2d(dtype=Any),
    recorded: wp.array2d(dtype=Any),
):
    kind = lanes.move[s]
    x = iterate[s, i]
    if kind == phases.TAKE_TRIAL:
        x = trial[s, i]
    elif kind == phases.RESTORE_RECORDED or kind == phases.REPEAT_RECORDED:
        x = recorded[s, i]
    elif kind == phases.RESET:
        x = state[s, i]
        if lanes.predicted[s] == 1:
            x += lanes.ratio[s] * (x - previous[s, i])
    elif kind == phases.ACCEPT:
        previous[s, i] = state[s, i]
        state[s, i] = x
    elif kind == phases.ROLL_BACK:
        x = previous[s, i]
        state[s, i] = x
    iterate[s, i] = x
    if keep == 1:
        recorded[s, i] = x


@wp.kernel
def move_fields(lanes: Lanes, solved: int, f: Fields):
    """One thread per (lane, node and then pressure): what `lanes.move` says.

    In phases of the set `solved` the solution at a recorded state is stored, in case a later pass fails.
    """
    s, i = wp.tid()
    count = f.state_u.shape[1]
    keep = (solved >> lanes.phase[s]) & 1
    if lanes.move[s] == 0 and keep == 0:
        return
    if i < count:
        _move(lanes, keep, s, i, f.state_u, f.previous_u, f.iterate_u, f.trial_u, f.recorded_u)
    else:
        _move(lanes, keep, s, i - count, f.state_p, f.previous_p, f.iterate_p, f.trial_p, f.recorded_p)


@wp.kernel
def clear_contact(lanes: Lanes, contact: ContactState):
    """One thread per (lane, face, point): nothing touched before in a fresh lane, not even what touches at once."""
    s, f, q = wp.tid()
    if lanes.phase[s] != phases.FRESH:
        return
    contact.normal[s, f, q] = wp.float64(0.0)
    contact.tangent[s, f, q] = wp.vec3d()
    contact.anchored[s, f, q] = 0
    contact.gap[s, f, q] = FAR


@wp.struct
class ContactMemory:
    """What corrections of a recorded state change of contact, (B, f, nq): see `synth.simulate.contact`.

    gap, tangential: of the last evaluation; the others are arrays of `ContactState`.
    """

    normal: wp.array3d(dtype=wp.float64)
    tangent: wp.array3d(dtype=wp.vec3d)
    anchor: wp.array3d(dtype=wp.vec3d)
    anchored: wp.array3d(dtype=wp.int32)
    gap: wp.array3d(dtype=wp.float64)
    tangential: wp.array3d(dtype=wp.vec3d)


@wp.kernel
def copy_memory(mask: wp.array(dtype=wp.int32), source: ContactMemory, target: ContactMemory):
    """One thread per (lane, face, point): save contact's memory, or restore it."""
    s, f, q = wp.tid()
    if mask[s] == 0:
        return
    target.normal[s, f, q] = source.normal[s, f, q]
    target.tangent[s, f, q] = source.tangent[s, f, q]
    target.anchor[s, f, q] = source.anchor[s, f, q]
    target.anchored[s, f, q] = source.anchored[s, f, q]
    target.gap[s, f, q] = source.gap[s, f, q]
    target.tangential[s, f, q] = source.tangential[s, f, q]


@wp.kernel
def save_multipliers(
    lanes: Lanes, contact: ContactState, normal: wp.array3d(dtype=wp.float64), tangent: wp.array3d(dtype=wp.vec3d)
):
    """One thread per (lane, face, point): before a pass begins."""
    s, f, q = wp.tid()
    if lanes.new_share[s] == wp.float64(0.0):
        return
    normal[s, f, q] = contact.normal[s, f, q]
    tangent[s, f, q] = contact.tangent[s, f, q]


@wp.kernel
def restore_multipliers(
    lanes: Lanes, normal: wp.array3d(dtype=wp.float64), tangent: wp.array3d(dtype=wp.vec3d), contact: ContactState
):
    """One thread per (lane, face, point): after a pass failed."""
    s, f, q = wp.tid()
    if lanes.move[s] != phases.RESTORE_RECORDED:
        return
    contact.normal[s, f, q] = normal[s, f, q]
    contact.tangent[s, f, q] = tangent[s, f, q]
